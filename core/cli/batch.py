"""`tricap batch`: many takes on a Dask cluster. Exit codes: 0 all done, 2 a take has invalid input, 1 a bug or a lost worker."""

import argparse
from pathlib import Path
from typing import Any

from ..foundation.errors import InputError
from ..foundation.progress import Cancelled, Monitor
from ..run.batch import RETRIES, Engine, Status, as_json, run_batch, summary
from .arguments import overrides


def add_command(commands: Any) -> None:
    """Join `batch` to the parser's commands."""
    about = "run many takes, on the processors of this machine or on a Dask cluster"
    parser = commands.add_parser("batch", help=about, description=about[0].upper() + about[1:])
    parser.add_argument("takes", type=Path, nargs="+", metavar="TAKE", help="folders with take.toml")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results; each take gets one in it")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, such as tcp://farm:8786; its workers need Tricap")
    where.add_argument("--workers", type=int, default=2, metavar="N", help="processes on this machine (default 2)")
    parser.add_argument(
        "--retries", type=int, default=RETRIES, metavar="N", help=f"retries of a take whose worker dies (default {RETRIES})"
    )
    parser.add_argument("--restart", action="store_true", help="start every take again instead of resuming")
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.NAME=VALUE", help="a setting, such as matching.patch_px=17")
    parser.add_argument("--json", action="store_true", help="print the outcomes as JSON, and nothing else on standard output")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Run the takes; the summary's lines.

    Raises:
        InputError: see `run_batch`.
        Cancelled: finished work is saved.
    """
    if not 1 <= args.workers <= 1000 or args.retries < 0:
        raise InputError(f"--workers {args.workers} and --retries {args.retries} are out of range; write 1 or more, and 0 or more.")
    engine = Engine(scheduler=args.scheduler, workers=min(args.workers, len(args.takes)), retries=args.retries)
    try:
        outcomes = run_batch(args.takes, args.out, engine, overrides(args.set), monitor, restart=args.restart)
    except Cancelled as stop:
        raise Cancelled(f"Stopped; {args.out / 'batch.json'} lists the finished takes, and the same command resumes.") from stop
    states = {o.status for o in outcomes}
    args.exit_code = 1 if states & {Status.BUG, Status.LOST} else 2 if Status.INVALID_INPUT in states else 0
    lines = summary(outcomes)
    args.always_shown = [line for line, outcome in zip(lines, outcomes) if outcome.status != Status.DONE]
    return [as_json(outcomes)] if args.json else lines
