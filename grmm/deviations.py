"""List where we deviate from the paper, why, and what effect was measured.

``grmm config --paper-diff`` prints the list for any settings; docs/PAPER.md holds the same tables.
Unless an effect says otherwise, it was measured on the demo's shards: three people, seven cameras
of 256 px, one camera held out, or a fourth person fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

from express50.files.text import markdown_table
from grmm.config import Config, as_tables, resolve

NOT_MEASURED = "not measured"


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """One deviation: what the paper has, what we have, why, and its effect."""

    paper: str
    ours: str
    reason: str
    effect: str = NOT_MEASURED


# With all settings, those of the preset ``paper`` included.
ALWAYS = (
    Deviation(
        paper="s_in = 0, s = delta_s",
        ours="s = softplus(delta_s + bias) mm, which starts at the texel spacing",
        reason="a Gaussian of size zero is invisible and gets no gradient (G2)",
    ),
    Deviation(
        paper="r_in in R^3 is 0, r = delta_r",
        ours="a quaternion, normalise(delta_r + identity)",
        reason="ten channels are 3 + 4 + 3, and zeros mean no rotation (G1)",
    ),
    Deviation(
        paper="N_g^2 Gaussians",
        ours="one per texel that a face covers: 200,476 of 262,144 on the built-in head",
        reason="the others have no place on the mesh (G19)",
    ),
    Deviation(
        paper="a face for the inner mouth",
        ours="a pouch of 65 vertices behind the lips",
        reason="teeth and tongue stand inside it (express50/head/mouth.py)",
    ),
    Deviation(
        paper="perceptual loss with VGG, weight 0.04",
        ours="the same with the user's weights (loss.vgg16); off without them, with a note",
        reason="we ship no third-party weights (G14)",
    ),
    Deviation(
        paper="tracking by VHAP, 68 FAN landmarks",
        ours="our own tracker; users may bring FAN's weights",
        reason="VHAP's licence (CONTRIBUTING.md)",
        effect="face 1.34 mm from the truth on the twin (docs/LOG.md); VHAP was not run",
    ),
    Deviation(
        paper="depth by ProbeSDF",
        ours="a level set moved to where the views agree (pipelines/depth)",
        reason="volume rendering took a minute more per frame and gained nothing",
        effect="median 0.293 mm with volume rendering and without (docs/LOG.md, What was removed)",
    ),
    Deviation(
        paper="mattes by RMBG-2.0 and BackgroundMattingV2, torso by Sapiens",
        ours="our own keys, cut-outs and part labels; these networks with the user's weights",
        reason="we ship no third-party weights",
    ),
    Deviation(
        paper="L2 of depth, no unit",
        ours="squared decimetres, over pixels that both cover, 2 px or more inside their borders",
        reason="in metres colours would outweigh the term, in millimetres it would dominate (G11)",
    ),
    Deviation(
        paper="L_z, the L2 norm of both codes",
        ours="the sum of their squares",
        reason="a norm pulls equally hard at any distance from zero, and has no slope there (G13)",
    ),
    Deviation(
        paper="losses over the picture",
        ours="over the window around head and matte, 16 px wider on each side",
        reason="the rest is background in both, so this only scales the losses",
    ),
    Deviation(
        paper="locality: neck and jaw by SLERP",
        ours="eyes by SLERP too, offsets linearly; I and I_rgb, in a random training camera",
        reason="the paper names no camera, and our meshes have eyes and offsets (G22)",
    ),
)

# By setting: why a preset has another value than ``paper``, and its effect.
REASONS: dict[str, tuple[str, str]] = {
    "data.skip_hidden_neck": (
        "the collar hides a different part of the neck in every view; as background, these"
        " views contradict each other",
        "neck of held-out views 20.6 to 25.2 dB, within 3 px of the collar 14.3 to 19.8, skin +0.05"
        " (120 steps of demo, 96 texels)",
    ),
    "data.hide_behind_torso": (
        "each camera looks behind the collar from a different side; no single end of the neck fits",
        "28.25 to 28.75 dB, with every pixel counted 22.1 to 28.5 (held-out views of six people,"
        " two and three seeds)",
    ),
    "model.refine_alpha": (
        "normalised depth is 0 at the nearest pixel and in the background; alpha separates them",
        NOT_MEASURED,
    ),
    "train.warm_start": (
        "projecting the footage gives at once the colours that thousands of steps would find",
        "+0.27 dB, on training views +1.2 (400 steps of demo, 27.60 to 27.88)",
    ),
    "loss.laplacian": (
        "the Laplacian of the mesh penalises the head's own curvature, so displacements are kept"
        " small instead",
        "`loss.displacement` instead: +0.25 dB (400 steps of demo, 27.63 to 27.88)",
    ),
    "loss.displacement": (
        "where the footage gives no evidence, the decoded mesh drifts off the tracked surface",
        "displacement 1.36 and 2.02 mm become 0.07 and 0.08; +0.12 and +0.21 dB, at ten times the"
        " weight +0.14 and +0.17 (700 steps, two seeds); on people with motions of their own +0.69"
        " (200 steps); in stage 2 of a fit from one view +1.2, from two +0.1 (two seeds)",
    ),
    "fit.texture_warm_start": (
        "the given pictures show most texels' colours",
        "+0.35 dB on held-out views (two views given, 28.44 to 28.79)",
    ),
    "fit.shuffle_directions": (
        "one or two views say little about how colours change with the direction",
        NOT_MEASURED,
    ),
    "model.frame": ("offsets turn with the jaw and the neck (G5)", NOT_MEASURED),
    "model.identity_modes": (
        "convolutions share weights over all texels and learn one person slowly (G6)",
        NOT_MEASURED,
    ),
}
OF_A_RUN = {
    "data.holdout_cameras", "data.holdout_expressions", "train.seed", "train.save_seconds",
    "train.evaluate_images",
}  # fmt: skip
SMALLER = ("a size or rate for a smaller machine", NOT_MEASURED)


def paper_diff(config: Config) -> list[str]:
    """List how settings deviate from the paper's, as Markdown lines."""
    letter = as_tables(resolve("paper"))
    rows = []
    for table in ("model", "loss", "data", "train", "fit"):
        for key, value in as_tables(config)[table].items():
            name = f"{table}.{key}"
            if value != letter[table][key] and name not in OF_A_RUN:
                shown = (_shown(letter[table][key]), _shown(value))
                rows.append([f"`{name}`", *shown, *REASONS.get(name, SMALLER)])
    lines = ["All settings are the paper's."]
    if rows:
        lines = markdown_table(["setting", "paper", "here", "reason", "measured effect"], rows)
    common = [[row.paper, row.ours, row.reason, row.effect] for row in ALWAYS]
    always = markdown_table(["paper", "here", "reason", "measured effect"], common)
    return [*lines, "", "With all settings:", "", *always]


def _shown(value: object) -> str:
    return str(list(value) if isinstance(value, tuple) else value)
