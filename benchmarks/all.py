"""Run the benchmarks that need no arguments, within one night, and keep their last lines."""

from __future__ import annotations

import json
import subprocess
import sys

# Hours on two cores, most of them in `ablate`, `align`, `track`, `depth` and `grmm`. `regions`
# needs the demo's dataset; `budget`, `demo`, `intervals`, `scale` and the sweeps take a night each.
NAMES = (
    "ablate", "align", "calibrate", "depth", "faults", "fps", "grmm", "head", "landmarks", "matte",
    "matte_views", "occluders --quick", "raster", "register", "shards", "stage_overhead", "track",
)  # fmt: skip


def main() -> int:
    """Run them and print one JSON object of their results; 1 if one failed."""
    results, failed = {}, []
    for name in NAMES:
        print(f"== {name}", file=sys.stderr, flush=True)
        done = subprocess.run(
            [sys.executable, "-m", *f"benchmarks.{name}".split()],
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
