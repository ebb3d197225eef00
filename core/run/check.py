"""The checks of a take and of a result as a run sees them: footage, rig and clicks, all settings, and what makes a stage out of date."""

from dataclasses import replace
from pathlib import Path

from ..checking import run_check, take_check
from ..checking.findings import Cause, Checked, Finding, wrong
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..results.run_json import read_run
from ..take.footage import open_take
from ..take.take import read_take
from .drawn_outlines import outlines_in, sentence
from .file_digests import FileDigests, reads_content
from .settings import settings_of
from .stages import STAGES, known_keys, stage_keys
from .take_run import only_frames

COMPARED = "compare.json"  # beside the halves of a comparison
NEW_OUTLINE = "The next run does not use it; draw a new one with `tricap contour`."
READ_BY = {"measure": "Images, masks or time stamps", "track": "Corrections", "fit": "Keypoints, outlines or body model"}


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


def check_run(folder: Path, monitor: Monitor) -> Checked:
    """All checks of the folder of a run, and whether the files of its take are still those that it read."""
    checked = run_check.check_run(folder, monitor)
    if any(finding.cause in (Cause.STALE_RESULT, Cause.INPUT) for finding in checked.findings):
        return checked
    return replace(checked, findings=(*checked.findings, *_other_files(folder)))


def _other_files(folder: Path) -> list[Finding]:
    """Footage, or another file, that was replaced or removed since the run. A take that no longer exists is not an error; one half of a
    comparison may have clicks that its take has not."""
    run, again = read_run(folder / "run.json"), "Run again; results that do not depend on it are reused."
    place = Path(run["take"])
    if not (place / "take.toml").is_file() or (folder.parent / COMPARED).is_file():
        return []
    try:
        settings = settings_of(run["settings"], {}, str(folder / "run.json"))
        footage = only_frames(open_take(read_take(place), click_sigma_px=settings["fitting"].click_sigma_px), tuple(run["frames"]))
        keys = stage_keys(footage, settings, folder)
        keys = known_keys(keys, run, lambda: stage_keys(footage, settings, folder, FileDigests().stamp) if reads_content(footage) else {})
        outlines = outlines_in(folder, run, footage, FileDigests())
    except InputError as error:
        return [wrong(Cause.STALE_RESULT, f"{place} cannot be read as it was for this run: {error}")]
    found = [wrong(Cause.STALE_RESULT, f"{sentence(folder, view)}.", NEW_OUTLINE) for view in outlines.outdated]
    for stage in STAGES:
        if run["stages"].get(stage, {}).get("key", keys[stage]) != keys[stage]:
            replaced = f"{READ_BY[stage]} of {place} were replaced since this run, or this version computes otherwise."
            return [wrong(Cause.STALE_RESULT, replaced, again), *found]
    return found
