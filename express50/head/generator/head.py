"""Make the built-in head: a full head in FLAME's layout with the variety of people.

Run `python -m express50.head.generator.head` after a change here: it rewrites `builtin.npz`, with
the mean and the shape directions of the old file. With `--people ict.npz` these are fitted again to
the people of ICT-FaceKit (`people`), which takes some minutes.

The generator draws a head by rule, with features placed by anthropometry (Farkas 1994). The mean of
people has the same vertices, and so its mesh, UV map, regions, landmarks and motions. Units are
millimetres while building and metres in the result.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from express50.geometry.sampling import smoothstep
from express50.head.generator.expressions import expression_directions
from express50.head.generator.features import add_eyeball, add_teeth, add_tongue, ball_centre
from express50.head.generator.field import window
from express50.head.generator.mesh import HalfMesh, WholeMesh, mirrored, neighbour_mean, pack_uv
from express50.head.generator.people import People, fit_people
from express50.head.generator.regions import contour_candidates, embed_landmarks, region_masks
from express50.head.generator.skin import add_skin, set_skin_uv
from express50.head.load import BUILTIN, load_builtin

Array = np.ndarray

ROOT, NECK, JAW, LEFT_EYE, RIGHT_EYE = range(5)
# Joints of the head drawn by rule, mm: collar, upper neck, jaw hinge.
JOINTS = np.array([(0, -165, -22), (0, -72, -16), (0, -8, 10)], float)


@cache
def procedural_mesh() -> WholeMesh:
    """Build the geometry of the head drawn by rule, in millimetres, once per process."""
    half = HalfMesh()
    add_skin(half)
    add_eyeball(half)
    add_teeth(half, upper=True)
    add_teeth(half, upper=False)
    add_tongue(half)
    set_skin_uv(half)
    return mirrored(half)


def write_builtin(path: Path, people: People) -> None:
    """Write the head's arrays, in metres, as the .npz file that `express50.head.load` reads."""
    mesh = procedural_mesh()
    mean = replace(mesh, vertices=people.mean)
    eyes = [ball_centre(mean, side) for side in ("left", "right")]
    joints = np.concatenate([people.joints, eyes])
    regions, contour = region_masks(mesh), contour_candidates(mesh)
    uv, uv_faces = pack_uv(mesh)
    landmark_faces, landmark_bary = embed_landmarks(mesh)
    weights = skinning_weights(mesh, regions)
    expression_names, expressions = expression_directions(
        mesh, mean, regions, weights[:, JAW], joints[JAW]
    )
    arrays = {
        "template": people.mean / 1000,
        "shape_dirs": np.round(people.directions / 1000, 6),
        "expression_dirs": expressions / 1000,
        "pose_dirs": pose_correctives(mesh, regions) / 1000,
        "joint_regressor": joint_regressor(mean, joints),
        "skinning": weights,
        "uv": uv,
        "landmark_bary": landmark_bary,
    }
    stored: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items()}
    stored |= {
        "faces": mesh.faces,
        "uv_faces": uv_faces,
        "landmark_faces": landmark_faces,
        "shape_names": [f"people_{k:02d}" for k in range(people.directions.shape[2])],
        "expression_names": expression_names,
        "contour": np.concatenate(contour),
        "contour_counts": [len(line) for line in contour],
        "region_names": list(regions),
        "regions": np.stack(list(regions.values())),
    }
    np.savez_compressed(path, **stored)


def stored_people() -> People:
    """Return the mean and the directions of the stored head."""
    head = load_builtin()
    template = 1000 * head.template.double().numpy()
    joints = head.joint_regressor.double().numpy()[:LEFT_EYE] @ template
    return People(template, 1000 * head.shape_dirs.double().numpy(), joints)


def joint_regressor(mesh: WholeMesh, joints: Array) -> Array:
    """Return weights (5,V) whose rows sum to 1: least-norm ones of the vertices near each joint."""
    regressor, skin = np.zeros((5, len(mesh.vertices))), mesh.tag("grid")
    for j, joint in enumerate(joints):
        if j >= LEFT_EYE:
            near = mesh.tag("eyeball", "left" if j == LEFT_EYE else "right")
        else:
            distance = np.linalg.norm(mesh.vertices[skin] - joint, axis=1)
            # Mirrored vertices are equally far, so distances are rounded to choose both.
            near = skin[np.argsort(distance.round(3), kind="stable")[:160]]
        system = np.concatenate([mesh.vertices[near].T, np.ones((1, len(near)))])
        regressor[j, near] = np.linalg.lstsq(system, np.append(joint, 1.0), rcond=None)[0]
    return regressor


# The jaw's weight along a lip loop, from the middle of the upper lip to that of the lower.
_CLOSURE = smoothstep(np.arange(33.0), 7.0, 25.0)


def jaw_weight(mesh: WholeMesh) -> Array:
    """Return the jaw joint's weight (V,): lower lip, chin, jaw line, lower teeth, tongue."""
    p = mesh.vertices
    angle = np.degrees(np.arctan2(p[:, 1] + 8, np.maximum(p[:, 2] - 10, 1.0)))
    around = smoothstep(angle, -18.5, -31.5)
    around *= smoothstep(p[:, 2], -14.0, 42.0) * smoothstep(p[:, 1], -138.0, -92.0)
    around[mesh.tag("ear")] = 0.0
    weight, fixed = around.copy(), np.zeros(len(p), bool)
    skin = mesh.faces[mesh.face_chart == "skin"]
    for k, f in enumerate((0.0, 0.1, 0.22, 0.38, 0.58, 0.8)):
        for which in ("left", "right"):
            ring = mesh.tag(f"lip{k}", which)
            weight[ring] = (1 - f) * _CLOSURE + f * around[ring]
            fixed[ring] = k <= 2
    for tag in ("ear_foot", "lid5"):
        weight[mesh.tag(tag)], fixed[mesh.tag(tag)] = 0.0, True
    for _ in range(10):
        weight = np.where(fixed, weight, 0.5 * (weight + neighbour_mean(weight, skin)))
    for k in range(7):
        deep = smoothstep(np.array(float(k)), 3.0, 8.0)
        for which in ("left", "right"):
            weight[mesh.tag(f"cavity{k}", which)] = _CLOSURE * (1 - 0.6 * deep)
    for tag, value in (("upper_teeth", 0.0), ("upper_gums", 0.0), ("lower_teeth", 1.0),
                       ("lower_gums", 1.0), ("throat", 0.2)):  # fmt: skip
        weight[mesh.tag(tag)] = value
    tongue = mesh.tag("tongue")
    weight[tongue] = 0.55 + 0.45 * smoothstep(mesh.vertices[tongue, 2], 42.0, 62.0)
    return weight


def skinning_weights(mesh: WholeMesh, regions: dict[str, Array]) -> Array:
    """Return weights (V,5) whose rows sum to 1: root for the collar, neck, jaw and eyes above."""
    p = mesh.vertices
    jaw = jaw_weight(mesh)
    height = p[:, 1] - 0.35 * (p[:, 2] + 20)  # the neck's own axis leans forward
    head = np.maximum(smoothstep(height, -150.0, -62.0), jaw)
    inside = regions["mouth_interior"] | regions["teeth"] | regions["tongue"]
    head[inside] = 1.0
    weights = np.zeros((len(p), 5))
    weights[:, JAW] = jaw
    weights[:, NECK] = head - jaw
    weights[:, ROOT] = 1.0 - head
    for joint, side in ((LEFT_EYE, "left"), (RIGHT_EYE, "right")):
        ball = regions[f"{side}_eyeball"]
        weights[ball] = 0.0
        weights[ball, joint] = 1.0
    return weights


def pose_correctives(mesh: WholeMesh, regions: dict[str, Array]) -> Array:
    """Return correctives (36,V*3) in mm per unit of R - I, for the jaw's opening alone.

    Opening by an angle a sets R[2,1] of the jaw to sin a. Then the corners of the mouth move in and
    the upper lip moves up a little, which skinning cannot express.
    """
    hard = regions["teeth"] | regions["gums"] | regions["tongue"]
    p, sign = mesh.vertices, np.sign(mesh.vertices[:, 0])
    folded = np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], 1)
    corner, upper, cheek = (
        np.where(hard, 0.0, window(folded, at, radius))
        for at, radius in (
            ((26, -49, 86), (15, 13, 24)),
            ((0, -42, 101), (22, 12, 20)),
            ((42, -42, 62), (18, 24, 26)),
        )
    )
    motion = np.zeros_like(p)
    motion[:, 0] = -sign * (12.0 * corner + 6.0 * cheek)
    motion[:, 1] = 5.0 * upper * (1 - jaw_weight(mesh))
    motion[:, 2] = 4.0 * corner
    result = np.zeros((36, p.size))
    result[9 * (JAW - 1) + 7] = motion.ravel()
    return result


def main(arguments: list[str] | None = None) -> int:
    """Write the head's file."""
    parser = argparse.ArgumentParser(
        prog="python -m express50.head.generator.head", description=__doc__
    )
    parser.add_argument("--people", type=Path, help="ICT-FaceKit's arrays (.npz) to fit people to")
    parser.add_argument("--out", type=Path, default=BUILTIN)
    options = parser.parse_args(arguments)
    mesh = procedural_mesh()
    write_builtin(
        options.out, fit_people(mesh, JOINTS, options.people) if options.people else stored_people()
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
