"""Glasses that crops of a head show are found before its mesh, and nothing behind them counts."""

from __future__ import annotations

import numpy as np

from express50.head.load import load_head
from pipelines.track.schedule import find_worn_glasses
from pipelines.track.surface import FrameSetCrops, HeadCrop, mask_things
from tests.pipelines.test_regions_glasses import eyes, painted, rims, scenes


def crops(places: np.ndarray, mattes: bool = True) -> FrameSetCrops:
    drawn = [painted(scene, places) for scene in scenes()]
    alphas = [np.rint(255 * one.alpha).astype(np.uint8) if mattes else None for one in drawn]
    return FrameSetCrops(
        (), tuple(HeadCrop(d.camera, d.rgb, a) for d, a in zip(drawn, alphas, strict=True))
    )


def test_glasses_are_taken_out_of_the_crops() -> None:
    model, mesh, pictures = load_head("procedural"), scenes()[0].head.vertices, crops(rims())
    found = find_worn_glasses(model, pictures, mesh, np.eye(3))
    assert len(found) > 500 and (found[:, 2] > eyes()[:, 2].min() - 0.04).all()
    front = pictures.crops[3]
    left = mask_things(pictures, found).crops[3].alpha
    assert left is not None and front.alpha is not None
    gone = (front.alpha > 0) & (left == 0)
    assert 0.01 < gone.mean() < 0.05
    assert len(find_worn_glasses(model, crops(rims()[:0]), mesh, np.eye(3))) == 0
    assert len(find_worn_glasses(model, crops(rims(), mattes=False), mesh, np.eye(3))) == 0
    assert len(find_worn_glasses(model, FrameSetCrops((), ()), mesh, np.eye(3))) == 0
