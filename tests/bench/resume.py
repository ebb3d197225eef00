"""How many killed runs are survived: `dev.py bench resume` kills 200 runs (about 15 minutes), a quarter by each
driver, with the fit at once and in stretches.

    python tests/bench/resume.py [--moments 200] [--seed 0] [--json FILE]
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import killing


def main() -> int:
    """Print the table: moments by stage and driver, and what was not survived."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--driver", choices=list(killing.DRIVERS), action="append")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    drivers, result = args.driver or list(killing.DRIVERS), {}
    with tempfile.TemporaryDirectory() as folder:
        killing.prepare_profile(Path(folder) / "profile")
        take = killing.tiny_take(Path(folder) / "take")
        for i, driver in enumerate(drivers):
            place = Path(folder) / f"runs{i}"
            place.mkdir()
            tally = killing.kill_runs(driver, take, place, -(-args.moments // len(drivers)), args.seed + i)
            result[driver] = {"moments": dict(sorted(tally.moments.items())), "runs": tally.runs, "faults": tally.faults}
            print(f"{driver}: {sum(tally.moments.values())} moments in {tally.runs} runs, {len(tally.faults)} not survived")
            for stage, count in sorted(tally.moments.items()):
                print(f"  {stage:<44} {count:4d}")
            for fault in tally.faults:
                print(f"  FAULT {fault}")
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 1 if any(table["faults"] for table in result.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
