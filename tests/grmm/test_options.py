"""The map's side, chosen from the images."""

import pytest

from grmm.checkpoint import load_checkpoint
from grmm.data import HeadViews
from grmm.model import GRMM
from grmm.train import train
from grmm.train_state import with_map_size
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
