"""What the fit knows of a subject, made ready for the refinement by rendering."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from express50.files.images import LIGHT_OF_LEVEL, srgb_to_linear
from express50.geometry.mesh_render import sh_light
from express50.head.model import HeadModel
from pipelines.track import appearance as model_of_light
from pipelines.track.bake import bake_albedo
from pipelines.track.config import TrackConfig
from pipelines.track.pictures import Moment
from pipelines.track.render_config import RenderConfig
from pipelines.track.render_loss import Appearance, Shot
from pipelines.track.render_refine import refine
from pipelines.track.shots import Shot as Crop
from pipelines.track.state import State, Target, all_vertices

# Near the end of the fit: small steps. Outlines were fitted before, against the whole mattes.
STEPS = RenderConfig(
    levels=(2, 1), outline=0.0, shape_rate=0.01, expression_rate=0.01,
    joint_rate=0.002, turn_rate=0.001, move_rate=0.0003,
)  # fmt: skip
TEXTURE_SIDE = 512
SURE = 0.98  # alpha, within a pixel, of what is the subject and nothing else


def rendered_like_pictures(
    model: HeadModel,
    targets: list[Target],
    state: State,
    moments: list[Moment],
    appearance: model_of_light.Appearance,
    config: TrackConfig,
) -> State:
    """The state moved so that its renderings look more like the pictures, in linear light.

    Colours are baked from the neutral moment (else the first); every moment is compared with them.
    """
    meshes = all_vertices(model, state)
    first = next((i for i, target in enumerate(targets) if target.neutral), 0)
    albedo, known = bake_albedo(
        model, meshes[[first]], [moments[first]], appearance, config.texture_side or TEXTURE_SIDE
    )
    if not known.any():
        return state
    look = Appearance(
        srgb_to_linear(albedo / 255.0).astype(np.float32),
        radiance(appearance.light),
        {name: gain**2 for name, gain in appearance.gains.items()},
    )
    shots = [[_shot(crop) for crop in moment.shots] for moment in moments]
    neutral = [target.neutral for target in targets]
    steps = replace(STEPS, rounds=config.render_rounds)
    found = refine(model, state, look, shots, neutral, config, steps).state
    return replace(found, bias=state.bias)


def radiance(light: np.ndarray) -> np.ndarray:
    """Coefficients (9, 3) as `sh_light` takes them, of light (9, 3) as `sh_basis` has it."""
    # Any normals will do of which no harmonic is a combination of the others.
    normals = np.random.default_rng(0).normal(size=(64, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    basis = sh_light(torch.from_numpy(normals), torch.eye(9, dtype=torch.float64)).numpy()
    wanted = model_of_light.sh_basis(normals) @ light
    return np.linalg.lstsq(basis, wanted, rcond=None)[0]


def _shot(crop: Crop) -> Shot:
    """A crop in linear light, trusted where nothing but the subject is in a pixel."""
    camera = replace(crop.camera, id=crop.camera_id)
    image = LIGHT_OF_LEVEL[crop.image].astype(np.float32)
    if crop.alpha is None:
        return Shot(camera, image, np.ones(image.shape[:2], np.float32))
    alpha = crop.alpha.astype(np.float32) / 255.0
    sure = cv2.erode(alpha, np.ones((3, 3), np.uint8)) > SURE
    return Shot(camera, image, sure.astype(np.float32), alpha)
