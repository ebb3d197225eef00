"""`tricap compare`: the published and the default method on one take, side by side on one page."""

import argparse
import json
from dataclasses import asdict

from ..foundation.progress import Monitor
from ..foundation.store import without_nan
from ..run.compare import as_lines, compare
from .arguments import frame_range, overrides


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Compare; the table's lines. Raises as `compare`."""
    measures = compare(args.take, args.out, overrides(args.set), frame_range(args.frames), monitor, restart=args.restart)
    if args.json:
        return [json.dumps(without_nan([asdict(m) | {"winner": m.winner} for m in measures]), indent=1, ensure_ascii=False)]
    return [*as_lines(measures), f"Page: {args.out / 'compare.html'}"]
