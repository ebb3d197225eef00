"""The check of a take as a run sees it: its footage, rig and clicks, and all of its settings."""

from dataclasses import replace
from pathlib import Path

from ..checking import take_check
from ..checking.findings import Cause, Checked, wrong
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..take.take import read_take
from .settings import settings_of


def check_take(folder: Path, monitor: Monitor) -> Checked:
    """All checks of a take before it is run; what a run would refuse is a finding."""
    checked = take_check.check_take(folder, monitor)
    try:
        take = read_take(folder)
        settings_of(take.settings, {}, str(take.folder / "take.toml"))
    except InputError as error:
        if str(error) not in [finding.sentence for finding in checked.findings]:
            return replace(checked, findings=(wrong(Cause.INPUT, str(error)), *checked.findings))
    return checked
