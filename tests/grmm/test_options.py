"""Options of training that the paper does not name."""

import builtins
import json
from dataclasses import replace

import pytest
import torch

from express50.errors import ConfigError
from grmm.checkpoint import load_checkpoint
from grmm.data import HeadViews
from grmm.model import GRMM
from grmm.objective import step
from grmm.run import prepare, set_rates, settle
from grmm.train import train
from tests.grmm.synthetic import EllipsoidSource, ellipsoid_head, tiny_config

pytestmark = pytest.mark.usefixtures("toy_head")


def test_averaged_weights_are_the_running_mean(source):
    config = tiny_config(train={"ema": 0.75})
    run = prepare(HeadViews(source, ellipsoid_head()), config)
    expected = None
    for _ in range(3):
        set_rates(run, config)
        step(run, run.model, config)
        now = run.model.z_id.detach().clone()
        expected = now if expected is None else 0.75 * expected + 0.25 * now
    torch.testing.assert_close(run.result.z_id, expected)
    assert not torch.equal(run.result.z_id, run.model.z_id)


def test_averaging_survives_a_resumed_run_bit_for_bit(tmp_path, source):
    settings = {"final_lr": 1.0, "ema": 0.9}
    config = tiny_config(train=settings | {"iterations": 5})
    train(source, ellipsoid_head(), tmp_path / "a", config)
    train(source, ellipsoid_head(), tmp_path / "b", tiny_config(train=settings | {"iterations": 2}))
    train(source, ellipsoid_head(), tmp_path / "b", config, resume=True)
    a, b = (torch.load(tmp_path / n / "checkpoint.pt", weights_only=True) for n in "ab")
    for where in ("model", ("loop", "weights")):
        x, y = (s["model"] if where == "model" else s["loop"]["weights"] for s in (a, b))
        assert all(torch.equal(x[name], y[name]) for name in x), where
    assert not torch.equal(a["model"]["z_id"], a["loop"]["weights"]["z_id"])
    kept = load_checkpoint(tmp_path / "a" / "checkpoint.pt").model.z_id
    assert torch.equal(kept, a["model"]["z_id"])


def test_low_precision_stays_inside_the_networks(source):
    """Gaussians and images are float32; the picture differs by what eight bits of mantissa cost."""
    torch.manual_seed(0)
    views = HeadViews(source, ellipsoid_head())
    item, config = views.item(0), tiny_config()
    model = GRMM(config.model, views.head, ("S000",), ("e0",))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.02 * torch.randn(parameter.shape)
    exact = model(0, 0, item.state, item.view)
    model.config = replace(config.model, precision="bfloat16")
    low = model(0, 0, item.state, item.view)
    gaussians = low.gaussians
    for tensor in (low.image, low.depth, gaussians.means, gaussians.quats, gaussians.scales_mm):
        assert tensor.dtype == torch.float32
    assert not torch.equal(low.image, exact.image)
    assert float((low.image - exact.image).abs().mean()) < 5e-3
    low.image.sum().backward()
    assert all(bool(torch.isfinite(p.grad).all()) for p in model.parameters() if p.grad is not None)


def test_low_precision_learns(tmp_path, source):
    config = tiny_config(model={"precision": "bfloat16"}, train={"iterations": 30, "log_every": 1})
    train(source, ellipsoid_head(), tmp_path, config)
    lines = [json.loads(x) for x in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert sum(x["loss"] for x in lines[-5:]) < sum(x["loss"] for x in lines[:5])


def test_tensorboard_has_the_terms(tmp_path, source):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = tiny_config(train={"tensorboard": True, "log_every": 1, "iterations": 3})
    train(source, ellipsoid_head(), tmp_path, config)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("train/loss")]
    lines = [json.loads(x) for x in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [n for n, _ in found] == [1, 2, 3]
    assert [v for _, v in found] == pytest.approx([x["loss"] for x in lines], rel=1e-5)


def test_missing_tensorboard_is_named(tmp_path, source, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **named):
        if name.startswith("torch.utils.tensorboard"):
            raise ImportError(name)
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"pip install 'express50\[tensorboard\]'"):
        train(source, ellipsoid_head(), tmp_path, tiny_config(train={"tensorboard": True}))


@pytest.mark.parametrize(("size", "ladder"), [(32, (8, 8)), (160, (8, 8)), (160, (8,))])
def test_map_follows_the_pixels_of_the_head(size, ladder):
    views = HeadViews(EllipsoidSource(size=size), ellipsoid_head())
    config = settle(tiny_config(model={"n_g": 0, "ladder": ladder}), views)
    pixels, n_g, coarse = int(views.item(0).mask.sum()), config.model.n_g, 2 ** (len(ladder) + 1)
    assert n_g % coarse == 0
    assert n_g == 2 * coarse or 2 * pixels <= 0.75 * n_g**2 < 4 * pixels + 4 * coarse * n_g
    assert len(GRMM(config.model, views.head, ("S000",), ("e0",)).texels) <= n_g**2


def test_a_chosen_map_is_kept_in_the_checkpoint(tmp_path, source):
    config = tiny_config(model={"n_g": 0}, train={"iterations": 1})
    train(source, ellipsoid_head(), tmp_path, config)
    assert load_checkpoint(tmp_path / "checkpoint.pt").config.model.n_g >= 16
    train(source, ellipsoid_head(), tmp_path, config, resume=True)


def test_a_given_map_is_left_alone(source):
    config = tiny_config()
    assert settle(config, HeadViews(source, ellipsoid_head())) is config
