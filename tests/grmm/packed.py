"""Shards of the toy data set, packed as the pack stage packs them."""

import json

import numpy as np

from express50.files.images import encode_jpeg, encode_png
from express50.shards.writer import PackedSample, ShardWriter

TINY = [
    "--set=model.n_g=32", "--set=model.ladder=[8, 8]", "--set=model.refine_widths=[8]",
    "--set=model.seed_channels=8", "--set=train.iterations=3", "--set=train.evaluate_images=2",
    "--set=fit.stage1_iterations=2", "--set=fit.stage2_iterations=2", "--preset=demo",
]  # fmt: skip
"""Flags of a run that takes a second."""


def packed(source, index):
    """One sample as the pack stage encodes it."""
    key, sample = source.keys[index], source.read(index)
    place = sample.place
    track = {k: np.asarray(v).tolist() for k, v in vars(place.tracked).items()}
    meta = {
        "subject": key.subject, "expression": key.expression, "camera": key.camera,
        "K": place.K.tolist(), "cam_from_world": place.cam_from_world.tolist(),
        "width": source.size, "height": source.size, "depth_scale_m": 5e-5,
        "head": "ellipsoid", "track": track,
    }  # fmt: skip
    depth = np.rint(sample.depth / 5e-5).astype(np.uint16)
    members = {
        "rgb.jpg": encode_jpeg(sample.image, 98),
        "alpha.png": encode_png(sample.alpha),
        "depth.png": encode_png(depth),
        "meta.json": json.dumps(meta).encode(),
    }
    return PackedSample(key.subject, key.expression, key.camera, members)


def write_shards(root, source, test_subjects=("S002",), subjects=None):
    """Pack a source's subjects, some of them in the test split."""
    writer = ShardWriter(root, 1 << 24)
    groups = {}
    for index, key in enumerate(source.keys):
        if subjects is None or key.subject in subjects:
            groups.setdefault((key.subject, key.expression), []).append(packed(source, index))
    for split in ("train", "test"):
        for (subject, _), samples in groups.items():
            if (subject in test_subjects) == (split == "test"):
                writer.add_group(split, samples)
    writer.close()
    return root
