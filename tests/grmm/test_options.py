"""The map's side, chosen from the images; what captions say of the pictures."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from grmm import render
from grmm.checkpoint import load_checkpoint
from grmm.data import HeadViews
from grmm.model import GRMM
from grmm.render import COLUMNS
from grmm.train import train
from grmm.train_state import prepare, with_map_size
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config


@pytest.mark.parametrize(("size", "ladder"), [(32, (8, 8)), (160, (8, 8)), (160, (8,))])
def test_map_follows_the_pixels_of_the_head(size, ladder):
    views = HeadViews(EllipsoidSource(size=size), ellipsoid_head())
    config = with_map_size(tiny_config(model={"n_g": 0, "ladder": ladder}), views)
    pixels, n_g, coarse = int(views.item(0).mask.sum()), config.model.n_g, 2 ** (len(ladder) + 1)
    assert n_g % coarse == 0
    assert n_g == 2 * coarse or 2 * pixels <= 0.75 * n_g**2 < 4 * pixels + 4 * coarse * n_g
    assert len(GRMM(config.model, views.head, ("S000",), ("e0",)).texels) <= n_g**2


def test_a_chosen_map_is_kept_in_the_checkpoint(tmp_path, source):
    config = tiny_config(model={"n_g": 0}, train={"iterations": 1})
    train(source, ellipsoid_head(), tmp_path, config)
    assert load_checkpoint(tmp_path / "checkpoint.pt").config.model.n_g >= 16
    train(source, ellipsoid_head(), tmp_path, config, resume=True)


def test_a_given_map_is_left_alone(views):
    config = tiny_config()
    assert with_map_size(config, views) is config


def test_the_captions_name_the_columns_of_comparison_sheets(views, tmp_path, monkeypatch):
    """Refined and drawn were once swapped in the README."""
    run = prepare(views, tiny_config())
    sheets = []
    monkeypatch.setattr(
        render, "write_sheet", lambda path, rows, *texts: sheets.append((rows, texts))
    )
    item = views.item(0)
    with torch.no_grad():
        out = run.model(0, 0, item.state, item.view)
    out = replace(out, image=torch.full_like(out.rgb, 0.25), rgb=torch.full_like(out.rgb, 0.75))
    render.comparison_sheet(tmp_path / "x.jpg", views, [0], lambda item: out)
    refined, drawn = (COLUMNS.split(", ").index(name) for name in ("refined", "drawn"))
    ((rows, (_, captions)),) = sheets
    assert rows[0][refined].max() == 64 and rows[0][drawn].min() == 191
    assert ", ".join(captions) == COLUMNS
    page = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    words = {"refined": "GRMM", "drawn": "GRMM without its refinement network"}
    caption = ", ".join(words.get(column, column) for column in COLUMNS.split(", "))
    assert page.count(caption) == 1
