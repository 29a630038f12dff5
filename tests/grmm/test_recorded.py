"""Recorded functions: what is recorded when, and that a recording follows inputs and weights."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from express50.head.load import load_head
from grmm import recorded
from grmm.config import resolve
from grmm.model import GRMM, HeadState, PinholeView
from grmm.recorded import Recorded, _Recording


@dataclasses.dataclass(frozen=True)
class Sums:
    """What the recorded function returns."""

    total: torch.Tensor
    scaled: torch.Tensor


def sums(layer: torch.nn.Linear, x: torch.Tensor, factor: float | torch.Tensor) -> Sums:
    return Sums(total=layer(x).sum(), scaled=x * factor)


def replayed_by_calling_again(function, values):
    """Stand in for a CUDA graph: the same inputs and outputs, filled anew by every play."""
    inputs = [v.clone() if isinstance(v, torch.Tensor) else torch.tensor(float(v)) for v in values]
    outputs = function(*inputs)

    def play() -> None:
        for mine, new in zip(vars(outputs).values(), vars(function(*inputs)).values(), strict=True):
            mine.copy_(new)

    return _Recording(play=play, inputs=inputs, outputs=outputs)


@pytest.fixture
def recordings(monkeypatch):
    """Record on a CPU as on a GPU; the list holds the shape of each recording's first input."""
    made = []

    def record(function, values):
        made.append(tuple(values[0].shape))
        return replayed_by_calling_again(function, values)

    monkeypatch.setattr(recorded, "_can_record", lambda values: not torch.is_grad_enabled())
    monkeypatch.setattr(recorded, "_record", record)
    return made


@torch.no_grad()
def test_the_second_call_records_and_later_ones_follow_inputs_and_weights(recordings):
    layer, function = torch.nn.Linear(3, 2), Recorded(sums)
    kept = []
    for call in range(4):
        x = torch.randn(5, 3)
        kept.append((function(x, call, module=layer), sums(layer, x, call)))
        assert len(recordings) == min(call, 1)
        layer.weight += 1.0  # as an optimiser does, in place
    for got, expected in kept:  # none was overwritten by a later call
        assert torch.equal(got.total, expected.total)
        assert torch.equal(got.scaled, expected.scaled)


@torch.no_grad()
def test_other_shapes_and_moved_weights_are_recorded_anew(recordings):
    layer, function = torch.nn.Linear(3, 2), Recorded(sums)
    for rows in (5, 5, 7, 7, 5):
        function(torch.ones(rows, 3), 1.0, module=layer)
    assert recordings == [(5, 3), (7, 3)]
    layer.weight = torch.nn.Parameter(torch.zeros(2, 3))  # elsewhere in memory
    for _ in range(2):
        found = function(torch.ones(5, 3), 1.0, module=layer)
    assert recordings == [(5, 3), (7, 3), (5, 3)]
    assert torch.allclose(found.total, 5 * layer.bias.sum())


@torch.no_grad()
def test_the_oldest_recordings_are_dropped(recordings):
    function = Recorded(lambda x: Sums(total=x.sum(), scaled=x))
    for rows in (1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 1, 1, 5):
        assert float(function(torch.ones(rows)).total) == rows
    assert recordings == [(1,), (2,), (3,), (4,), (5,), (1,)]


@torch.no_grad()
def test_four_recordings_are_kept(recordings):
    function = Recorded(lambda x: Sums(total=x.sum(), scaled=x))
    for rows in (1, 1, 2, 2, 3, 3, 4, 4, 1, 1):
        function(torch.ones(rows))
    assert recordings == [(1,), (2,), (3,), (4,)]


@torch.no_grad()
def test_what_cannot_be_recorded_is_called_as_usual(recordings, monkeypatch, capsys):
    tried = []

    def fail(function, values):
        tried.append(len(values))
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 2.00 GiB")

    monkeypatch.setattr(recorded, "_record", fail)
    function = Recorded(lambda x: Sums(total=x.sum(), scaled=x))
    for call in range(4):
        assert float(function(torch.full((2,), call)).total) == 2 * call
    assert tried == [1] and capsys.readouterr().err.count("\n") == 1


@torch.no_grad()
def test_another_device_is_recorded_anew(recordings):
    function = Recorded(lambda x: Sums(total=x.sum(), scaled=x))
    for device in ("cpu", "cpu", "meta", "meta"):
        found = function(torch.ones(2, device=device))
    assert recordings == [(2,), (2,)] and found.scaled.device.type == "meta"


def test_nothing_is_recorded_where_gradients_are_wanted(recordings):
    layer, function = torch.nn.Linear(3, 2), Recorded(sums)
    for _ in range(3):
        function(torch.ones(1, 3), 1.0, module=layer).total.backward()
    assert not recordings and layer.weight.grad is not None


@torch.no_grad()
def test_nothing_is_recorded_on_a_cpu():
    layer, function = torch.nn.Linear(3, 2), Recorded(sums)
    for _ in range(3):
        found = function(torch.ones(1, 3), 2.0, module=layer)
    assert torch.equal(found.scaled, torch.full((1, 3), 2.0))


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("preset", ["paper", "paper-plus", "demo"])
def test_a_model_draws_the_same_recorded(preset):
    device, head = torch.device("cuda"), load_head("procedural").to("cuda")
    model = GRMM(resolve(preset).model, head, ("S000",), ("neutral",)).to(device).eval()
    state = HeadState(
        vertices=head.template,
        shape=torch.randn(head.shape_dirs.shape[2], device=device),
        expression=torch.randn(len(head.expression_names), device=device),
        neck=torch.zeros(3, device=device),
        jaw=torch.full((3,), 0.1, device=device),
    )
    K = torch.tensor([[700.0, 0, 64], [0, 700.0, 64], [0, 0, 1]], dtype=torch.float64)
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    pose[2, 3] = 1.0
    view = PinholeView(K=K.to(device), cam_from_head=pose.to(device), width=128, height=128)
    kept = []
    for _ in range(4):  # plain, recorded, played, played
        with torch.no_grad():
            for parameter in model.parameters():
                parameter += 0.01 * torch.randn_like(parameter)
            view.cam_from_head[0, 3] += 0.01
            state.vertices.mul_(1.01)
            got = model(0, 0, state, view)
        expected = model(0, 0, state, view)  # gradients are wanted, so nothing is recorded
        kept.append([(vars(out), vars(out.gaussians)) for out in (got, expected)])
    for (images, gaussians), (true_images, true_gaussians) in kept:
        for name in ("means", "quats", "scales_mm", "opacities", "displacement"):
            torch.testing.assert_close(gaussians[name], true_gaussians[name].detach())
        for name in ("image", "depth", "alpha"):
            error = (images[name] - true_images[name].detach()).abs()
            assert float(error.mean()) < 1e-4 and float(images[name].std()) > 0.01, name
