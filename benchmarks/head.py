"""Measure how well the built-in head fits unseen people, and how human its dimensions are.

``python -m benchmarks.head --ict ict.npz [--sheet PATH]``: identities are drawn from ICT-FaceKit's
published model, given as scans without colours (which are turned and moved), and fitted by the
built-in head's parameters alone (`pipelines.register.scan`). `face` and `head` are distances of the
fitted vertices to the identity's surface; `mean_only` is the same with the mean head laid onto them
rigidly. `measures_mm` are means and standard deviations of sampled built-in heads beside adult
means of men and women from Farkas, "Anthropometry of the Head and Face", 1994. The sheet shows
sampled built-in heads from three sides with ICT's beside. The last line printed is one JSON object.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import torch

from benchmarks.common import make_parser
from express50.geometry.raycast import mesh_scene
from express50.geometry.transforms import axis_angle_to_matrix, rigid_fit
from express50.head.load import load_builtin, load_head
from express50.head.model import HeadModel, in_regions, landmarks, landmarks_of, pose
from express50.head.preview import render_preview
from pipelines.register.scan import fit_scan
from pipelines.register.scan_input import GREY, Scan

SAMPLES = 200
SHEET_PEOPLE, SHEET_SIDES, SHEET_PX = 24, (0.0, 40.0, 90.0), 160
# Pairs of landmarks, and the means of men and women, mm.
MEASURES = {
    "inner eye corners (en-en)": (39, 42, 33.3, 31.8),
    "outer eye corners (ex-ex)": (36, 45, 91.2, 87.8),
    "mouth width (ch-ch)": (48, 54, 54.5, 50.2),
    "nose height (n-sn)": (27, 33, 54.8, 50.6),
    "face height (n-gn)": (27, 8, 124.7, 111.4),
}


def main(arguments: list[str] | None = None) -> int:
    """Fit unseen people, measure sampled ones, and print the figures."""
    parser = make_parser("head", __doc__)
    parser.add_argument("--ict", help="ICT-FaceKit: a checkout or an .npz of its arrays")
    parser.add_argument("--people", type=int, default=8, help="identities to fit")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--sheet", type=Path, help="write a sheet of sampled heads here")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    own = load_builtin()
    result: dict = {"benchmark": "head"}
    result["measures_mm"] = measure(own, options.seed)
    if options.ict is None:
        result |= dict.fromkeys(("face", "head", "mean_only"), "n/a: --ict names no file")
    else:
        other = load_head(options.ict)
        result |= fit_people(own, other, options.people, options.seed)
        if options.sheet is not None:
            cv2.imwrite(str(options.sheet), sheet(own, other, options.seed)[..., ::-1])
    print(json.dumps(result))
    return 0


def draw_people(model: HeadModel, count: int, seed: int) -> np.ndarray:
    """Return resting people (count, V, 3) of a model, metres; coefficients are standard normal."""
    size = len(model.shape_names)
    shapes = np.random.default_rng(seed).standard_normal((count, size)).astype(np.float32)
    with torch.no_grad():
        return pose(model, torch.from_numpy(shapes), torch.zeros(count, 1)).double().numpy()


def fit_people(own: HeadModel, other: HeadModel, count: int, seed: int) -> dict:
    """Return distances of fitted built-in heads to identities of another model, pooled."""
    faces = other.faces.numpy()
    distances: dict[str, list[np.ndarray]] = {"face": [], "head": [], "mean_only": []}
    began = time.process_time()
    for number, person in enumerate(draw_people(other, count, seed)):
        rng = np.random.default_rng([seed, number])
        turn = axis_angle_to_matrix(rng.normal(0.0, 0.5, 3))
        placed = person @ turn.T + rng.normal(0.0, 0.1, 3)
        used, corners = np.unique(faces, return_inverse=True)
        grey = np.full((len(used), 3), GREY)
        scan = Scan(placed[used], corners.reshape(-1, 3), grey, "metres", False)
        fitted = fit_scan(scan, "procedural").start
        scene, middle = mesh_scene(placed - placed.mean(0), faces), placed.mean(0)
        for name, mesh in (("face", fitted), ("head", fitted), ("mean_only", laid(own, fitted))):
            at = o3d.core.Tensor((mesh - middle)[region(own, name)].astype(np.float32))
            distances[name].append(1e3 * scene.compute_distance(at).numpy())
        print(f"person {number}: face {np.median(distances['face'][-1]):.3f} mm", file=sys.stderr)
    result: dict = {name: {"point_to_surface_mm": spread(rows)} for name, rows in distances.items()}
    seconds = (time.process_time() - began) / count
    return result | {"people": count, "seconds_per_person": round(seconds, 2)}


def laid(model: HeadModel, fitted: np.ndarray) -> np.ndarray:
    """Return the mean head (V, 3) laid rigidly onto a fitted one's face."""
    template = model.template.double().numpy()
    face = region(model, "face")
    turn, shift = rigid_fit(template[face], fitted[face])
    return template @ turn.T + shift


def region(model: HeadModel, name: str) -> np.ndarray:
    """Mark the vertices (V,) of the face, or of the face, scalp, ears and neck for "head"."""
    names = ("face", "scalp", "left_ear", "right_ear", "neck") if name == "head" else ("face",)
    return in_regions(model, names)


def spread(rows: list[np.ndarray]) -> dict[str, float]:
    """Return median, 95th percentile and root mean square."""
    all_of = np.concatenate(rows)
    return {
        "median": round(float(np.median(all_of)), 4),
        "p95": round(float(np.percentile(all_of, 95)), 4),
        "rms": round(float(np.sqrt(np.mean(all_of**2))), 4),
    }


def measure(model: HeadModel, seed: int) -> dict[str, dict[str, float]]:
    """Return mean and deviation of measures of sampled heads, and the tables' means."""
    people = 1e3 * draw_people(model, SAMPLES, seed)
    marks = landmarks(model, torch.from_numpy(people).float()).double().numpy()
    regions = {name: mask.numpy() for name, mask in model.regions.items()}
    ear, skull = regions["left_ear"], regions["scalp"] | regions["forehead"]
    found = {
        name: (np.linalg.norm(marks[:, a] - marks[:, b], axis=1), (men, women))
        for name, (a, b, men, women) in MEASURES.items()
    }
    # Of the skull above the ears, so that these do not count.
    high = skull & (model.template[:, 1].numpy() > 0.045)
    found["head breadth (eu-eu)"] = np.ptp(people[:, high, 0], axis=1), (151.1, 144.1)
    found["head length (g-op)"] = np.ptp(people[:, skull, 2], axis=1), (197.3, 187.5)
    found["ear length (sa-sba)"] = np.ptp(people[:, ear, 1], axis=1), (62.4, 58.5)
    return {
        name: {
            "mean": round(float(values.mean()), 1),
            "deviation": round(float(values.std()), 1),
            "men": men,
            "women": women,
        }
        for name, (values, (men, women)) in found.items()
    }


def sheet(own: HeadModel, other: HeadModel, seed: int) -> np.ndarray:
    """Draw built-in heads (left) and the other model's (right), three sides each."""
    halves = []
    for model in (own, other):
        people = draw_people(model, SHEET_PEOPLE, seed)
        mark = landmarks_of(model).astype(np.float64)[27]
        people = people - mark + [0.0, 0.024, 0.1]
        tiles = [
            np.concatenate([render_preview(model, v, yaw=y, size=SHEET_PX) for y in SHEET_SIDES], 1)
            for v in people
        ]
        rows = [np.concatenate(tiles[k : k + 2], 1) for k in range(0, SHEET_PEOPLE, 2)]
        halves.append(np.concatenate(rows, 0))
    gap = np.full((len(halves[0]), 16, 3), 255, np.uint8)
    return np.concatenate([halves[0], gap, halves[1]], 1)


if __name__ == "__main__":
    sys.exit(main())
