"""Checkpoints and weights whose sizes are not those of their tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from express50.errors import TrainError
from express50.files.checkpoints import read_weights
from tests.fuzz.seeds import read_checkpoint

HUGE = 10**6
SIZES: dict[str, object] = {
    "n_g": HUGE, "z_id": HUGE, "z_exp": HUGE, "features": HUGE, "seed_channels": HUGE,
    "ladder": [HUGE, HUGE], "shared_widths": [HUGE, HUGE], "film_width": HUGE, "mesh_width": HUGE,
    "refine_widths": [HUGE, HUGE], "refine_unshuffle": HUGE, "identity_modes": -1,
}  # fmt: skip
ODD: dict[str, object] = {
    "n_g": 16 * 10**400, "z_id": -HUGE, "features": 1 << 62, "refine_unshuffle": 1 << 40,
    "shared_widths": [8] * 100_000, "ladder": [8] * 100_000, "mesh_width": 0,
}  # fmt: skip


def checkpoint_bombs(root: Path, out: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Name and reading of each."""
    content = torch.load(root / "checkpoint.pt", weights_only=True)
    config = content["config"]

    def written(name: str, changed: dict[str, object]) -> Callable[[], object]:
        folder = out / name.replace(" ", "_")
        folder.mkdir()
        torch.save(content | changed, folder / "checkpoint.pt")
        return lambda: read_checkpoint(folder)

    for number, sizes in enumerate((SIZES, ODD)):
        for key, value in sizes.items():
            name = f"checkpoint {number} of {key}"
            model = config["model"] | {key: value}
            yield name, written(name, {"config": config | {"model": model}})
    both = {"config": config | {"model": config["model"] | {"n_g": 1 << 14}}}
    tensors = {
        name: torch.zeros(1).expand([1 << 14 if n == 32 else n for n in tensor.shape])
        for name, tensor in content["model"].items()
    }
    yield "checkpoint of one number", written("one number", both | {"model": tensors})
    wide = {"cam00": content["cameras"]["cam00"] | {"width": HUGE, "height": HUGE}}
    yield "checkpoint of a wide camera", written("wide camera", {"cameras": wide})
    many = {"subjects": [f"S{n}" for n in range(100_000)]}
    yield "checkpoint of many people", written("many people", many)
    for name, tensor in {
        "repeated": torch.zeros(1).expand(HUGE, HUGE),
        "sparse": torch.sparse_coo_tensor(torch.zeros(2, 1), torch.ones(1), (HUGE, HUGE)),
        "absent": torch.zeros(HUGE, HUGE, device="meta"),
    }.items():
        file = out / f"{name}.pth"
        torch.save({"a": [tensor]}, file)
        yield f"weights {name}", lambda f=file: read_weights(f, TrainError, str(f), "a state dict")
