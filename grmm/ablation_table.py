"""The rows of the ablation and the table they end in, as the paper prints its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from express50.contract.config import nearest
from express50.errors import ConfigError
from express50.files.atomic import write_bytes, write_json
from grmm.config import Config
from grmm.evaluate import HELD_EXPRESSION, HELD_VIEW
from grmm.judge import Judge
from grmm.unseen import NOVEL_EXPRESSION, NOVEL_VIEW


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One row: what it is called, what it changes, and what the paper found.

    Attributes:
        label: as in the table.
        changes: table -> key -> value over the common configuration.
        paper_db: the paper's PSNR minus that of its full model; None: no figure.
        trains_as: the row whose checkpoint it uses, where only the fit differs.
        without: the folder of shards left out.
    """

    label: str
    changes: Mapping[str, Mapping[str, object]]
    paper_db: float | None = None
    trains_as: str = ""
    without: Path | None = None


VARIANTS = {
    "full": Variant(label="Full model", changes={}),
    "no_residuals": Variant(
        label="W/o residuals", changes={"model": {"residual_codes": False}}, paper_db=-1.63
    ),
    "no_mesh_decoder": Variant(
        label="W/o mesh decoder", changes={"model": {"mesh_decoder": False}}, paper_db=-2.18
    ),
    "no_refinement": Variant(
        label="W/o refinement", changes={"model": {"refine_widths": []}}, paper_db=-0.77
    ),
    "no_mouth_uv": Variant(label="W/o mouth UV", changes={"model": {"mouth": False}}),
    "no_locality": Variant(
        label="W/o locality loss",
        changes={"fit": {"locality": 0.0}},
        paper_db=-0.68,
        trains_as="full",
    ),
}
DATASET_PREFIX = "without_"
GROUPS = {"view": HELD_VIEW, "expression": HELD_EXPRESSION, "unseen": NOVEL_VIEW,
          "unseen_expression": NOVEL_EXPRESSION}  # fmt: skip
SHOWN = ("psnr_db", "psnr_head_db", "ssim", "rmse", "lpips")


def variants_of(roots: Sequence[Path], names: Sequence[str] = ()) -> dict[str, Variant]:
    """The rows asked for, all by default; with several datasets one row without each.

    Raises:
        ConfigError: no row has such a name.
    """
    rows = dict(VARIANTS)
    if len(roots) > 1:
        for root in roots:
            name = root.parent.parent.name if root.name == "shards" else root.name
            rows[DATASET_PREFIX + name] = Variant(label=f"W/o {name}", changes={}, without=root)
    for name in names:
        if name not in rows:
            raise ConfigError(
                f"row {name!r} is unknown{nearest(name, rows)}; expected {', '.join(rows)}"
            )
    # The full model comes first: others are compared with it, and no_locality uses its weights.
    return {name: row for name, row in rows.items() if not names or name in (*names, "full")}


def write_tables(
    out: Path, rows: Mapping[str, dict], variants: Mapping[str, Variant], config: Config
) -> None:
    """Write ablation.json and ablation.md of the rows measured so far."""
    full = rows["full"]["groups"]
    table = {
        name: row
        | {
            "difference_db": {
                group: round(numbers["psnr_db"] - full[group]["psnr_db"], 3)
                for group, numbers in row["groups"].items()
                if group in full and None not in (numbers["psnr_db"], full[group]["psnr_db"])
            }
        }
        for name, row in rows.items()
    }
    budget = {"seconds": config.train.seconds or None, "iterations": config.train.iterations}
    missing = Judge(config.metrics).missing()
    write_json(
        out / "ablation.json",
        {"rows": table, "budget": budget, "holdout_cameras": list(config.data.holdout_cameras)}
        | missing,
    )
    write_bytes(out / "ablation.md", markdown(table, missing).encode())


def markdown(table: Mapping[str, dict], missing: Mapping[str, str]) -> str:
    """The table as the paper prints its own: one row a model, PSNR, SSIM and LPIPS a protocol."""
    groups = [g for g in GROUPS if any(g in row["groups"] for row in table.values())]
    head = ["Method"]
    for group in groups:
        head += [f"{GROUPS[group]}: PSNR", "SSIM", "LPIPS", "dB over full"]
    lines = [head + ["paper, dB"], ["---"] * (len(head) + 1)]
    for row in table.values():
        cells = [row["label"]]
        for group in groups:
            numbers = row["groups"].get(group, {})
            cells += [_cell(numbers.get(name), d) for name, d in _DIGITS.items()]
            cells.append(_cell(row["difference_db"].get(group), 2, sign=True))
        lines.append([*cells, _cell(row["paper_db"], 2, sign=True)])
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return text + "".join(f"\n{name.upper()}: {reason}\n" for name, reason in missing.items())


_DIGITS = {"psnr_db": 2, "ssim": 3, "lpips": 3}


def _cell(value: float | None, digits: int, sign: bool = False) -> str:
    return "n/a" if value is None else f"{value:{'+' if sign else ''}.{digits}f}"
