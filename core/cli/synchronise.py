"""`tricap synchronise TAKE [--write]`: when each view began, and how exactly. Exit code 2: some view was not found."""

import argparse
import json

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..synchronising.synchronise import synchronise, write_starts
from ..take.take import read_take
from ..take.writing import COPIED, has_comments


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Find the beginnings, show them, and write them where that is asked for and all were found. Lost views set the exit code to 2.

    Raises:
        InputError: a sound or an image cannot be read; a view was not found.
    """
    take = read_take(args.take)
    timings = synchronise(take, monitor, args.movie_sound)
    lost = [timing for timing in timings if not timing.found]
    if lost and (args.write or len(lost) == len(timings) - 1):
        raise InputError(" ".join(["Nothing was written." if args.write else "No view was found.", *map(str, lost)]))
    args.exit_code = 2 if lost else 0
    args.always_shown = [str(timing) for timing in lost]
    commented = has_comments(take.folder)
    written = args.write and write_starts(take.folder, timings)
    if args.json:
        return [json.dumps({timing.view: timing.to_table() for timing in timings}, indent=1)]
    return [*map(str, timings), *([f"{take.folder / 'take.toml'} has them.{COPIED if commented else ''}"] if written else [])]
