"""Give a head's textured mesh the 52 blend shapes that ARKit names, as glTF morph targets.

Each shape is one or two coefficients of a head model that has them by name (the built-in head,
ICT-FaceKit), the jaw's turn, or an eye's; the mesh decoder answers too.
"""

from __future__ import annotations

import json
import struct

import numpy as np
import torch

from express50.errors import ConfigError
from grmm.checkpoint import Loaded
from grmm.edit import HeadCodes, controlled
from grmm.splat_files import FLOAT, glb_bytes

SIDED = (
    "eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide",
    "mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch", "mouthPress", "mouthLowerDown",
    "mouthUpperUp", "browDown", "browOuterUp", "cheekSquint", "noseSneer",
)  # fmt: skip
SINGLE = (
    "jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker",
    "mouthLeft", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower",
    "mouthShrugUpper", "browInnerUp", "cheekPuff", "tongueOut",
)  # fmt: skip
JAW, EYE = 0.35, 0.4  # radians of jawOpen and of eyeLook...
TURNS = {  # of joints: entry of an axis-angle, and its sign; the left is +x
    "jawOpen": ("jaw.0", 1), "eyeLookDownLeft": ("eyes.0", 1), "eyeLookDownRight": ("eyes.3", 1),
    "eyeLookUpLeft": ("eyes.0", -1), "eyeLookUpRight": ("eyes.3", -1),
    "eyeLookOutLeft": ("eyes.1", 1), "eyeLookInLeft": ("eyes.1", -1),
    "eyeLookInRight": ("eyes.4", 1), "eyeLookOutRight": ("eyes.4", -1),
}  # fmt: skip


def arkit_controls(names: tuple[str, ...]) -> dict[str, list[tuple[str, float]]]:
    """Return the controls that each of the 52 shapes moves, and by how much.

    Raises:
        ConfigError: the head model lacks a shape's coefficients, as FLAME does.
    """
    table: dict[str, tuple[str, ...]]
    table = {name: (name, f"{name}_L", f"{name}_R") for name in SINGLE}
    for name in SIDED:
        table |= {f"{name}Left": (f"{name}_L",), f"{name}Right": (f"{name}_R",)}
    controls = {}
    for shape, candidates in table.items():
        known = [name for name in candidates if name in names]
        moves = [(f"expression.{name}", 1.0) for name in known]
        if shape in TURNS:
            entry, sign = TURNS[shape]
            moves.append((entry, sign * (JAW if shape == "jawOpen" else EYE)))
        if not moves:
            raise ConfigError(
                f"--format arkit: the head model has no coefficient for {shape}; expected one with "
                "named expressions: the built-in head or ICT-FaceKit"
            )
        controls[shape] = moves
    return controls


@torch.no_grad()
def arkit_targets(loaded: Loaded, head: HeadCodes) -> dict[str, np.ndarray]:
    """Return what each shape adds to the head's vertices, (V, 3) metres."""

    def vertices(codes: HeadCodes) -> np.ndarray:
        state = codes.state(loaded)
        moved = loaded.model.geometry(codes.z_id, codes.z_exp, state).displacement
        return np.asarray((state.vertices + moved).cpu())

    rest, tracked, targets = vertices(head), head.tracked, {}
    for shape, moves in arkit_controls(loaded.head.expression_names).items():
        changes = {}
        for name, amount in moves:
            table, _, entry = name.partition(".")
            # A coefficient goes to 1 whatever it is at rest; a joint turns on from there.
            own = 0.0 if table == "expression" else float(getattr(tracked, table)[int(entry)])
            changes[name] = (own + amount,)
        targets[shape] = vertices(controlled(loaded, head, changes)) - rest
    return targets


def with_morph_targets(glb: bytes, positions: np.ndarray, targets: dict[str, np.ndarray]) -> bytes:
    """Add morph targets to a GLB of one mesh, whose P POSITIONs are vertices ``positions``."""
    size = struct.unpack("<I", glb[12:16])[0]
    document, body = json.loads(glb[20 : 20 + size]), glb[28 + size :]
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    primitive["targets"] = []
    for moved in targets.values():
        table = np.ascontiguousarray(moved[positions], "<f4")
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": table.nbytes}
        accessor = {
            "bufferView": len(document["bufferViews"]), "componentType": FLOAT, "type": "VEC3",
            "count": len(table), "min": table.min(0).tolist(), "max": table.max(0).tolist(),
        }  # fmt: skip
        primitive["targets"].append({"POSITION": len(document["accessors"])})
        document["bufferViews"].append(view)
        document["accessors"].append(accessor)
        body += table.tobytes()
    mesh["weights"] = [0.0] * len(targets)
    mesh["extras"] = {"targetNames": list(targets)}
    document["buffers"][0]["byteLength"] = len(body)
    return glb_bytes(document, body)
