"""`tricap check`: what is wrong or doubtful about a take, a rig or a result. Exit code 0: nothing, 1: something."""

import argparse
import json
from pathlib import Path

from ..checking.findings import Cause, Checked, wrong
from ..foundation.errors import InputError
from ..foundation.progress import Monitor


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
        from ..run.check import check_run

        return check_run(subject, monitor)
    if (subject / "take.toml").is_file() or (subject.name == "take.toml" and subject.is_file()):
        from ..take.take import read_take

        try:
            read_take(subject)  # a damaged one is reported before the stages are imported
        except InputError as error:
            return Checked(subject=str(subject), kind="take", findings=(wrong(Cause.INPUT, str(error)),), figures={})
        from ..run.check import check_take

        return check_take(subject, monitor)
    if subject.is_file() and subject.suffix.lower() == ".toml":
        from ..checking.rig_check import check_rig

        return check_rig(subject)
    from ..results.folder import has_checkpoints

    if has_checkpoints(subject / "cache"):
        from ..checking.run_check import not_measured

        return Checked(subject=str(subject), kind="result", findings=(not_measured(subject),), figures={})
    raise InputError(
        f"{subject} is neither a take (a folder with take.toml), nor a result (with run.json), nor a rig.toml; check the path."
    )
