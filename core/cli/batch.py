"""`tricap batch`: many takes on a Dask cluster. Exit codes: 0 all done, 2 a take has invalid input, 1 a bug or a lost worker."""

import argparse

from ..foundation.errors import InputError
from ..foundation.progress import Cancelled, Monitor
from ..run.batch import Status, as_json, run_batch, summary
from ..run.engine import Engine
from .arguments import overrides

MOST_WORKERS = 1000


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Run the takes; the summary's lines.

    Raises:
        InputError: see `run_batch`.
        Cancelled: finished work is saved.
    """
    if not 1 <= args.workers <= MOST_WORKERS:
        raise InputError(f"--workers {args.workers} is out of range; write 1 to {MOST_WORKERS}.")
    if args.retries < 0:
        raise InputError(f"--retries {args.retries} is out of range; write 0 or more.")
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
