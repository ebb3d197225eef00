"""`tricap check`: what is wrong or doubtful about a take, a rig or a result. Exit code 0: nothing, 1: something."""

import argparse
import json
from pathlib import Path
from typing import Any

from ..checking.findings import Checked
from ..checking.rig_check import check_rig
from ..checking.run_check import check_run
from ..checking.take_check import check_take
from ..foundation.errors import InputError
from ..foundation.progress import Monitor


def add_command(commands: Any) -> None:
    """Join `check` to the parser's commands."""
    about = "what is wrong or doubtful about a take, a rig or a result, and what to do"
    parser = commands.add_parser("check", help=about, description=about[0].upper() + about[1:])
    parser.add_argument("subject", type=Path, metavar="TAKE|OUT|RIG", help="folder of a take or of a run, or rig.toml")
    parser.add_argument("--json", action="store_true", help="print the findings and figures as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Check; the lines to show. The exit code of the command becomes 1 if there are findings.

    Raises:
        InputError: it is neither a take, nor a result, nor a rig.
    """
    checked = check(args.subject, monitor)
    args.exit_code = 1 if checked.findings else 0
    args.always_shown = checked.lines() if checked.findings else []
    return [json.dumps(checked.to_table(), indent=1, ensure_ascii=False)] if args.json else checked.lines()


def check(subject: Path, monitor: Monitor) -> Checked:
    """The findings about a take, a result or a rig, distinguished by their files.

    Raises:
        InputError: it is none of them.
    """
    if (subject / "run.json").is_file():
        return check_run(subject, monitor)
    if (subject / "take.toml").is_file() or (subject.name == "take.toml" and subject.is_file()):
        return check_take(subject, monitor)
    if subject.is_file() and subject.suffix.lower() == ".toml":
        return check_rig(subject)
    raise InputError(
        f"{subject} is neither a take (a folder with take.toml), nor a result (with run.json), nor a rig.toml; check the path."
    )
