"""Read the twin's ground truth: meshes, depth and alpha are made on demand from the parameters.

The reader lies outside of the product, so that no stage can open the truth.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from express50.errors import CaptureError
from express50.files.arrays import read_arrays
from express50.files.calibration import read_cameras
from express50.geometry.cameras import Camera, rays
from express50.geometry.transforms import make_transform, rigid_fit
from express50.head.load import load_head
from express50.head.model import HeadModel
from express50.twin.body import Body, Extras, assemble, head_vertices, pose_body
from express50.twin.hair import HairMesh
from express50.twin.render import Sampling, bands, hull_of, render_band, window_of
from express50.twin.studio import OF_PLAY
from express50.twin.subjects import PersonLook, TwinPerformance, TwinSubject
from express50.twin.surface import MISS, Caster
from express50.twin.worn import WornMesh, bare

SKIN_M = 0.5e-3  # what is this near to the skin counts as skin, as roots of hair do


class Truth:
    """Reads what `write_truth` of the studio wrote; everything is in the true world, metres."""

    def __init__(self, root: Path) -> None:
        """Open ``OUT/truth`` of a recording; CaptureError if the folder holds no truth."""
        self.root = Path(root)
        if not self.subjects():
            raise CaptureError(
                f"{root}: holds no truth; expected the truth folder that 'express50 twin record'"
                " writes beside captures"
            )
        self._subject = lru_cache(maxsize=4)(self._read_subject)
        self._scene = lru_cache(maxsize=4)(self._compile)

    def subjects(self) -> list[str]:
        """Return the ids of the recorded subjects."""
        return sorted(path.parent.name for path in self.root.glob("*/subject.json"))

    def cameras(self, subject: str) -> dict[str, Camera]:
        """Return the rig's true cameras, distorted, by id."""
        return read_cameras(self.root / subject / "cameras.json")

    def peaks(self, subject: str) -> dict[str, int]:
        """Return the frame of each expression's peak."""
        return dict(self._subject(subject)[1].peaks)

    def head_model(self, subject: str) -> HeadModel:
        """Return the head model that the subject was made with."""
        return self._subject(subject)[0].model

    def parameters(self, subject: str, frame: int) -> dict[str, np.ndarray]:
        """Return a frame's shape, offsets, expression, jaw, neck, eyes, R, t, strength."""
        body, play = self._play(subject, frame)
        values = {name: getattr(play, name)[frame] for name in OF_PLAY}
        return {"shape": body.subject.shape, "offsets": body.subject.offsets} | values

    def vertices(self, subject: str, frame: int) -> np.ndarray:
        """Return the head model's vertices (V, 3) in the world."""
        body, play = self._play(subject, frame)
        return head_vertices(body.model, body.subject, play, frame)

    def mesh(self, subject: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices (N, 3) and faces (F, 3) of all geometry except lenses."""
        body = self._subject(subject)[0]
        return self._scene(subject, frame)[1], body.faces[: body.solid]

    def render_depth(
        self, subject: str, frame: int, camera: Camera
    ) -> tuple[np.ndarray, np.ndarray]:
        """Render depth (H, W) float32, camera z in metres, 0 where empty; and validity (H, W) bool.

        Lenses are invisible here, and in `render_alpha` and `skin`.
        """
        return render_depth(self._scene(subject, frame)[0], camera)

    def skin(self, subject: str, frame: int, camera: Camera) -> np.ndarray:
        """Mark the pixels (H, W) bool where nothing hides the head's own surface."""
        depth, valid = self.render_depth(subject, frame, camera)
        caster = Caster(self.vertices(subject, frame), self.head_model(subject).faces.numpy())
        bare, there = render_depth(caster, camera)
        return valid & there & (np.abs(bare - depth) < SKIN_M)

    def surface(self, subject: str, frame: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Intersect the ray through each pixel's centre with the scene.

        Returns:
            material (H, W) int16, a `Material`, -1 where nothing is; vertex (H, W) int64, the
            corner nearest to the hit among ``mesh``'s vertices (the head model's come first).
        """
        caster, vertices = self._scene(subject, frame)
        body = self._subject(subject)[0]
        if body.solid < len(body.faces):
            caster = Caster(vertices, body.faces)
        origin, directions = rays(camera)
        _, face, uv = caster.cast(origin, directions.reshape(-1, 3))
        hit = face != MISS
        corner = np.column_stack([1 - uv.sum(1), uv]).argmax(1)
        face = np.where(hit, face, 0)
        material = np.where(hit, body.material[face].astype(np.int16), np.int16(-1))
        vertex = body.faces[face, corner].astype(np.int64)
        return material.reshape(directions.shape[:2]), vertex.reshape(directions.shape[:2])

    def hairiness(self, subject: str) -> np.ndarray:
        """Return the density of hair (V,) per head vertex, 0 to 1; 0 on bald subjects."""
        body = self._subject(subject)[0]
        return body.scalp if len(body.extras.hair.faces) else np.zeros_like(body.scalp)

    def render_alpha(self, subject: str, frame: int, camera: Camera) -> np.ndarray:
        """Render alpha (H, W) float32 in [0, 1], from 33 rays per pixel at silhouettes."""
        caster, vertices = self._scene(subject, frame)
        return render_alpha(caster, self._subject(subject)[0].material, vertices, camera)

    def _compile(self, subject: str, frame: int) -> tuple[Caster, np.ndarray]:
        body, play = self._play(subject, frame)
        vertices = pose_body(body, play, frame).vertices
        return Caster(vertices, body.faces[: body.solid]), vertices

    def _play(self, subject: str, frame: int) -> tuple[Body, TwinPerformance]:
        """Return a subject and its performance, which must have the frame."""
        body, play = self._subject(subject)
        if not 0 <= frame < play.frames:
            raise ValueError(
                f"{subject}: frame {frame} not in truth, expected 0..{play.frames - 1}"
            )
        return body, play

    def _read_subject(self, subject: str) -> tuple[Body, TwinPerformance]:
        folder = self.root / subject
        if not (folder / "subject.json").is_file():
            raise CaptureError(
                f"{self.root}: no truth of subject {subject!r}, expected one of"
                f" {', '.join(self.subjects())}"
            )
        about = json.loads((folder / "subject.json").read_text())
        peaks = json.loads((folder / "peaks.json").read_text())
        stored = {path.stem: read_arrays(path, CaptureError, "truth")
                  for path in folder.glob("*.npz")}  # fmt: skip
        play = TwinPerformance(
            cues=tuple((str(e), int(a), int(b)) for e, a, b in about["cues"]), peaks=peaks,
            **{name: stored["frames"][name] for name in OF_PLAY},
        )  # fmt: skip
        data, own = stored["body"], stored.get("own", {}).get("own")
        look: dict[str, Any] = about["look"]
        look |= {name: np.array(value) for name, value in look.items() if isinstance(value, list)}
        person = TwinSubject(
            id=about["id"], number=about["number"], shape=data["shape"], offsets=data["offsets"],
            look=PersonLook(**look), own=own,
        )  # fmt: skip
        # What is needed for colours alone stays empty.
        blank = np.zeros_like(data["hair_vertices"])
        hair = HairMesh(
            vertices=data["hair_vertices"], faces=data["hair_faces"], tangents=blank, normals=blank,
            colours=blank, moves=data.get("hair_moves", np.full(len(blank), -1)),
        )  # fmt: skip
        parts = stored.get("worn", {"hand": np.zeros((0, 4, 4)), **vars(bare())})
        hand = parts.pop("hand")
        extras = Extras(
            hair=hair, cloth_vertices=data["cloth_vertices"], cloth_faces=data["cloth_faces"],
            skull=data["skull"], skull_rest=data["skull_rest"], worn=WornMesh(**parts), hand=hand,
        )  # fmt: skip
        body = assemble(load_head(about["head"]), person, extras, data["scalp"], data["centre"])
        return body, play


def align_worlds(estimated: Mapping[str, Camera], true: Mapping[str, Camera]) -> np.ndarray:
    """Return ``world_true_from_estimated`` (4, 4), rigid, from the cameras that both rigs have.

    Each camera counts with its centre and the ends of its axes, a metre long, so that even two
    cameras, or cameras in one line, determine the rotation.

    Raises:
        ValueError: no camera is in both.
    """
    shared = sorted(set(estimated) & set(true))
    if not shared:
        raise ValueError(
            f"rigs share no camera: estimated {sorted(estimated)}, true {sorted(true)}"
        )
    source = np.concatenate([_frame_points(estimated[name]) for name in shared])
    target = np.concatenate([_frame_points(true[name]) for name in shared])
    return make_transform(*rigid_fit(source, target))


def _frame_points(camera: Camera) -> np.ndarray:
    pose = camera.world_from_cam
    ends = pose[:3, 3] + pose[:3, :3].T
    # Both ends of every axis, so that the points' mean is the centre.
    return np.concatenate([pose[None, :3, 3], ends, 2 * pose[:3, 3] - ends])


def render_alpha(
    caster: Caster, material: np.ndarray, vertices: np.ndarray, camera: Camera
) -> np.ndarray:
    """Render the alpha (H, W) float32 in [0, 1] of geometry in a camera, with 33 rays at edges."""
    alpha = np.zeros((camera.height, camera.width), np.float32)
    window = window_of(camera, hull_of(vertices))
    sampling = Sampling(edge=33, inside=1, sparing=False)
    for band in bands(camera):
        done = render_band(caster, material, window, band, sampling, None)
        if done is not None:
            _, part, place = done
            alpha[place] = part
    return alpha


def render_depth(caster: Caster, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render camera z (H, W) float32, metres, 0 where nothing is hit; and validity (H, W) bool."""
    depth = np.zeros((camera.height, camera.width), np.float32)
    for band in bands(camera):
        part = band.centre[band.rows]
        # Directions have camera z 1, so the distance along them is camera z.
        distance, _, _ = caster.cast(band.origin, part.reshape(-1, 3))
        distance = np.where(np.isfinite(distance), distance, 0.0)
        depth[band.top : band.bottom] = distance.reshape(part.shape[:2])
    return depth, depth > 0
