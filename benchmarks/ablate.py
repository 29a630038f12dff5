"""Measure GRMM's components on people whose motions no head model has: ``-m benchmarks.ablate``.

The twin's people smile, fold and redden in ways of their own (``--personal 1``). Footage goes
through every stage; then `grmm.ablate` trains and fits the model whole, and without one component
at a time, with several seeds. Differences are of a row to the row that it is compared with, dB,
with half of their 95 % interval; ``earned`` lists the groups and regions in which a component's
loss is beyond its interval. `identity_modes` are off, as in the paper: without residuals, shape
coefficients would drive them. ``contributes_db`` is what the whole model loses on held-out views
when a component is taken out after training: near 0 means that training left it inert. ``--quick``
takes a smaller twin and shorter trainings. The last line is one JSON object.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch

from benchmarks.common import make_parser
from benchmarks.grmm import held_out, make_shards
from express50.files.atomic import write_json
from grmm.ablate import GROUPS, Ablation, ablate
from grmm.config import resolve
from grmm.fit import FitProtocol

ROWS = ("no_residuals", "no_mesh_decoder", "no_refinement", "no_locality")
EXPRESSIONS = ("neutral", "smile", "jaw_open", "pucker", "brow_raise", "wink_left", "anger",
               "surprise")  # fmt: skip
TWIN = {"subjects": 5, "first-subject": 71, "cameras": 8, "width": 256, "height": 256,
        "frames-per-expression": 4}  # fmt: skip
PERSONAL = ("--personal=1",)
ITERATIONS, FIT = 2000, (120, 200)
QUICK_TWIN = TWIN | {"subjects": 4, "cameras": 7, "width": 224, "height": 224}
QUICK_EXPRESSIONS, QUICK_ITERATIONS, QUICK_FIT = 4, 150, (30, 40)


def differences(row: dict) -> dict[str, dict[str, tuple[float, float | None]]]:
    """Return a row's differences and intervals, dB, by group and region."""
    found: dict[str, dict[str, tuple[float, float | None]]] = {}
    for group in GROUPS:
        if group in row["difference_db"]:
            whole = row["difference_db"][group], row["interval_db"][group]
            regions = row["regions_db"][group].items()
            named = {key.removeprefix("psnr_").removesuffix("_db"): pair for key, pair in regions}
            found[group] = {"all": whole, **named}
    return found


def earned(found: dict[str, dict[str, tuple[float, float | None]]]) -> list[str]:
    """Name the groups and regions in which a row loses by more than its interval."""
    return [
        f"{group}/{region}"
        for group, regions in found.items()
        for region, (gain, half) in regions.items()
        if half is not None and gain < -half
    ]


def measure(shards: Path, out: Path, changes: list[str], seeds: int, images: int) -> dict:
    """Train and fit every row on one folder of shards."""
    config, given = held_out(shards, resolve("demo", None, changes))
    protocol = FitProtocol(cameras=(given[0], given[1]), expression="neutral", images=images)
    run = Ablation(roots=[shards], out=out, config=config, protocol=protocol, seeds=seeds)
    table = ablate(run, ROWS)["rows"]
    rows = {name: differences(row) for name, row in table.items() if name != "full"}
    metrics = json.loads((out / "full" / "metrics.json").read_text())
    return {
        "psnr_db": {name: row["psnr_db"] for name, row in table["full"]["groups"].items()},
        "differences_db": rows,
        "earned": {name: earned(found) for name, found in rows.items() if name in ROWS},
        "paper_db": {name: table[name]["paper_db"] for name in ROWS},
        "contributes_db": metrics["components_gain_db"],
        "iterations": table["full"]["iterations"],
        "seeds": seeds,
    }


def main() -> None:
    """Parse, measure, print."""
    parser = make_parser("ablate", __doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("build/benchmark_ablate"))
    parser.add_argument("--quick", action="store_true", help="smaller twin, shorter trainings")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of every row")
    parser.add_argument("--images", type=int, default=24, help="pictures per row and group")
    parser.add_argument("--set", nargs="*", default=[], metavar="TABLE.KEY=VALUE", dest="changes")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    count, twin, steps, fit = len(EXPRESSIONS), TWIN, ITERATIONS, FIT
    if args.quick:
        count, twin, steps, fit = QUICK_EXPRESSIONS, QUICK_TWIN, QUICK_ITERATIONS, QUICK_FIT
    expressions = EXPRESSIONS[:count]
    shards = make_shards(args.out, args.threads, twin, expressions, PERSONAL)
    torch.set_num_threads(args.threads)
    budget = [
        "model.identity_modes=0",
        f"train.iterations={steps}",
        f"fit.stage1_iterations={fit[0]}",
        f"fit.stage2_iterations={fit[1]}",
        f"train.evaluate_images={args.images}",
    ]
    changes = [*budget, *args.changes]
    result = measure(shards, args.out / "ablation", changes, args.seeds, args.images)
    write_json(args.out / "ablate.json", result)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
