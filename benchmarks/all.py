"""Run every benchmark that needs no arguments, one after the other; their last lines are kept."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SKIPPED = {
    "__init__",
    "calibrate_footage",
    "all",
    "demo",
    "document",
    "tradeoff",
    "accuracy",
    "depth",
    "regions",
    "regions_truth",
    "track_truth",
    "track_views",
    "matte_scenes",
    "matte_disturbances",
    "raster_scene",
}


def main() -> int:
    """Run them and print one JSON object of their results; 1 if one failed."""
    names = sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem not in SKIPPED)
    results, failed = {}, []
    for name in names:
        print(f"== {name}", file=sys.stderr, flush=True)
        done = subprocess.run(
            [sys.executable, "-m", f"benchmarks.{name}"],
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        lines = done.stdout.strip().splitlines()
        if done.returncode or not lines:
            failed.append(name)
        else:
            results[name] = json.loads(lines[-1])
    print(json.dumps({"results": results, "failed": failed}))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
