"""Score pictures that any method made: a folder of images named as the shards' samples.

Named ``<subject>_<expression>_<camera>.png`` (or .jpg), of the size as packed. They pass through
the same comparison as our own renderings: same crop, same background, same pixels counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from express50.errors import FormatError
from express50.files.images import read_image, write_image
from express50.shards.writer import sample_key
from grmm.data import HeadViews, SampleKey
from grmm.evaluate import Row, compare, row_of
from grmm.perceptual_metrics import PerceptualMetrics
from grmm.shard_source import ShardSource

SUFFIXES = (".png", ".jpg", ".jpeg")
NAMED = 5  # how many wrong files an error names


def sample_name(key: SampleKey) -> str:
    """Name a sample as the shards do, which is also its picture's name."""
    return sample_key(key.subject, key.expression, key.camera)


def find_picture(folder: Path, key: SampleKey) -> Path | None:
    """Find the picture of a sample; None if there is none."""
    paths = (folder / f"{sample_name(key)}{suffix}" for suffix in SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


@torch.no_grad()
def score(
    folder: Path,
    source: ShardSource,
    views: HeadViews,
    indices: Sequence[int],
    judge: PerceptualMetrics,
    kind: Callable[[SampleKey], str] = lambda key: "",
    partial: bool = False,
) -> list[Row]:
    """Score pictures, one row each; ``partial`` leaves samples without a picture out.

    Raises:
        FormatError: missing, unreadable or mis-sized pictures, which are named.
    """
    found = {index: find_picture(folder, views.keys[index]) for index in indices}
    missing = [sample_name(views.keys[i]) for i, path in found.items() if path is None]
    if missing and (not partial or len(missing) == len(found)):
        raise FormatError(
            f"{folder}: {len(missing)} of {len(found)} pictures are missing: {_list(missing)}; "
            "expected SUBJECT_EXPRESSION_CAMERA.png. Score part of them with --partial or choose "
            "samples with --subjects, --expressions, --cameras"
        )
    paths = {index: path for index, path in found.items() if path is not None}
    checked = (_problem(path, source.window(index)[2]) for index, path in paths.items())
    wrong = [problem for problem in checked if problem]
    if wrong:
        raise FormatError(f"{folder}: {len(wrong)} pictures do not fit: {_list(wrong)}")
    rows = []
    for index, path in paths.items():
        item = views.item(index)
        rows_seen, columns_seen, size = source.window(index)
        pixels = _pixels(path, size)[rows_seen, columns_seen]
        image = torch.from_numpy(pixels.copy()).permute(2, 0, 1).to(item.target) / 255
        rows.append(row_of(item.key, kind(item.key), compare(image, item, judge)))
        judge.remember(kind(item.key), item.comparable(image), item.target)
    return rows


def save_pictures(folder: Path, source: ShardSource, background: float) -> Callable:
    """Make a function that writes renderings of samples as `score` reads them."""
    folder.mkdir(parents=True, exist_ok=True)

    def keep(index: int, image: Tensor) -> None:
        rows, columns, size = source.window(index)
        whole = np.full((*size, 3), round(255 * background), np.uint8)
        shown = (255 * image.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()
        whole[rows, columns] = shown
        write_image(folder / f"{sample_name(source.keys[index])}.png", whole)

    return keep


def _problem(path: Path, size: tuple[int, int]) -> str | None:
    """Describe why a picture cannot be scored; None if it can."""
    try:
        pixels = read_image(path)
    except FormatError as error:
        return f"{path.name} ({error})"
    if pixels.shape[:2] != size:
        got, expected = (f"{width} x {height}" for height, width in (pixels.shape[:2], size))
        return f"{path.name} is {got}, expected {expected}"
    if pixels.dtype != np.uint8:
        return f"{path.name} has {pixels.dtype} pixels, expected 8 bits per channel"
    return None


def _pixels(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Read (H, W, 3) uint8; grey is repeated over the channels, a fourth one is left out."""
    pixels = read_image(path)
    if pixels.ndim == 2 or pixels.shape[2] < 3:
        pixels = np.repeat(pixels.reshape(*size, -1)[..., :1], 3, axis=2)
    return pixels[..., :3]


def _list(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
