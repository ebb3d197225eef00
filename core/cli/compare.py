"""`tricap compare`: the published and the default method on one take, side by side on one page.

With truth.npz in the take, as in recordings of `tricap demo`, both are also scored against it.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation.progress import Monitor
from ..foundation.store import without_nan
from ..report.comparison import DEFAULT, HIGHER, LOWER, PUBLISHED, Measure
from ..run.compare import as_lines, as_row, measures_of, run_both, write_comparison
from ..synthetic.score import Score, score_run
from .arguments import frame_range, overrides

TRUTH = "Against the truth"  # group of measures


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Compare; the table's lines. Raises as `run_both`."""
    take: Path = args.take
    halves = run_both(take, args.out, overrides(args.set), frame_range(args.frames), monitor, restart=args.restart)
    measures = measures_of(halves, monitor)
    if (take / "truth.npz").is_file():
        scores = {method: score_run(take, folder, monitor) for method, folder in halves.folders.items()}
        measures = [*_of_truth(scores.get(PUBLISHED), scores[DEFAULT]), *measures]
    write_comparison(args.out, take, halves, measures)
    if args.json:
        return [json.dumps(without_nan([as_row(m) for m in measures]), indent=1, ensure_ascii=False)]
    return [*as_lines(measures), *(f"Note: {note}" for note in halves.notes), f"Page: {args.out / 'compare.html'}"]


def _of_truth(published: Score | None, default: Score) -> list[Measure]:
    """The measures against the truth."""
    wanted = (
        ("coverage of the true surface", "%", HIGHER, lambda s: 100 * s.clouds.coverage),
        ("error of a point (median)", "mm", LOWER, lambda s: s.clouds.median_mm),
        ("error of a point (95 %)", "mm", LOWER, lambda s: s.clouds.p95_mm),
        ("points off by 10 mm or more", "%", LOWER, lambda s: 100 * s.clouds.gross_fraction),
        ("error of a trajectory (median)", "mm", LOWER, lambda s: s.trajectories.median_mm),
        ("places of trajectories off by 10 mm or more", "%", LOWER, lambda s: 100 * s.trajectories.false_fraction),
        ("error of the joints (mean)", "mm", LOWER, lambda s: s.joints.mpjpe_mm),
        ("error of the joints' motion (rms)", "mm", LOWER, lambda s: s.joints.motion_rms_mm),
        ("error of the bends of elbows and knees (rms, mean)", "°", LOWER, lambda s: np.mean([h.rms_deg for h in s.hinges.values()])),
        ("error of the skin (median)", "mm", LOWER, lambda s: s.skin.median_mm),
    )

    def value(score: Score | None, of: Any) -> float:
        try:
            return float(of(score))
        except AttributeError:  # the score or a part of it is None: there is no such run, or it lacks that result
            return float("nan")

    return [
        Measure(group=TRUTH, name=n, unit=u, published=value(published, of), default=value(default, of), better=b) for n, u, b, of in wanted
    ]
