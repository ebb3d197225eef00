"""A run under way: the opened take, its settings, the locked folder of its results, and the record that becomes run.json."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ..body.model_file import read_model
from ..body.motion import BodyFit
from ..body.skin.mesh import SkinSettings
from ..fitting.inputs.no_surface import empty_clouds
from ..fitting.inputs.start_joints import NeedsClick, StartJoints
from ..fitting.inputs.take_inputs import check_body
from ..fitting.stages.set_up import NobodyFound
from ..foundation import store
from ..foundation.errors import InputError
from ..foundation.progress import Cancelled, Monitor
from ..report.pages import check_pictured
from ..report.pictures import png
from ..report.question import question_picture
from ..report.silhouettes import Silhouettes
from ..results import blend_file, earlier_body, edited_tables, films
from ..results.folder import MADE_BY, Results, check_separate_folder, lost
from ..results.own_files import QUESTION, files_of
from ..results.run_json import ASKS
from ..surface.cloud import PointCloud
from ..surface.frames import MeasuredFrames
from ..surface.resolution import clicked_distance_m, measured_footage, person_seen, shows_enough
from ..surface.starts import MeasureSettings
from ..take.clicked_points import clicked_depth
from ..take.footage import Footage, open_take
from ..take.sources import is_number
from ..take.take import Take, read_take
from ..tracking.corrections import corrected_cloud
from ..tracking.trajectories import Trajectories
from . import drawn_outlines
from .engine import Engine
from .file_digests import FileDigests, reads_content
from .record import frame_table, new_record, write_frame_table
from .settings import Overrides, settings_of
from .stages import CONTENT, STAGE_FILES, STAGE_INPUTS, STAGES, STAMPED, known_keys, stage_keys, valid_stages

SURFACE = "surface"  # of the measured stage in run.json: the digest of the keys of its frames, with the content of their images
OTHER_IMAGES = "The images are not those that were measured before; tracks and body of these were removed."
IN_FULL_SIZE = "The images are measured in full size, for reduced ones show next to nothing; that takes longer."
REPLACED = "Images or other files of the take were replaced or removed during this run, so its results do not fit each other. Run it again."
FIT_STEPS = ("cache/fit_rough", "cache/fit", "cache/fit_again")  # checkpoints of a fit under way
FITTED = "cache/body"


@dataclass(kw_only=True)
class Run:
    """A run under way: an opened take, its settings, and the folder for its results. `record` becomes run.json."""

    footage: Footage
    settings: dict[str, Any]
    results: Results
    keys: Mapping[str, str] = field(default_factory=dict)  # of the stages: see stages.py
    content_keys: Mapping[str, str] = field(default_factory=dict)  # by the content of files in place of their times, where it was read
    body_key: str = ""  # that of the fit, whatever the skin
    replaced: Callable[[], bool] = bool  # whether files that the surface was measured from are others than when the run began
    digests: FileDigests = field(default_factory=FileDigests)
    record: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  # what the user should know of the folder, and not of its results
    keeps_body: bool = False  # the files of an earlier fit stay until the next one, also where they are out of date
    measured: MeasuredFrames = field(init=False)
    trajectories: Trajectories | None = None
    body: BodyFit | None = None
    distance_m: float | None = None  # of the person, for whose motion large images are reduced; None: unknown
    in_full_size: bool = False  # the images are not reduced all the same, for they would show next to nothing
    begin: int | None = None  # the frame from which the surface is measured, if not the usual one (`surface.beginning`)
    surfaceless: bool = False  # nothing could be measured, or nothing is to be
    silhouettes: Silhouettes = field(default_factory=Silhouettes)
    engine: Engine | None = None  # where the frames are measured; None: in this process
    pictured: Sequence[int] = ()  # the frames of the report's pictures; none: the first, a middle and the last
    close_ups: bool = True  # of the person, in the report
    colour_limits: Mapping[str, float] = field(default_factory=dict)  # of pictures in the report, if not their own

    def __post_init__(self) -> None:
        self.measured = MeasuredFrames(footage=self.footage, results=self.results)
        measured = self.record["stages"].get("measure", {})
        if is_number(told := measured.get("distance_m")) and told > 0:
            self.distance_m = float(told)
        if measured.get("reduction", 1.0) == 1.0:
            if self.distance_m is not None and self.measured_footage.full_size_px:
                self._measure_in_full_size()
        elif self.distance_m is None:  # results of earlier versions do not tell it; it was that of the clicks
            self.distance_m = clicked_distance_m(self.measured_footage)

    @property
    def reduced_for_m(self) -> float | None:
        """The distance of the person for whom the images are reduced, where they are; None: they are not."""
        return None if self.in_full_size else self.distance_m

    @property
    def measured_footage(self) -> Footage:
        """The footage at the size at which its surface is measured and tracked."""
        return measured_footage(self.footage, MeasureSettings.of(self.settings), self.reduced_for_m)

    def choose_image_size(self, monitor: Monitor) -> None:
        """Reduce large images, unless reduced ones show next to nothing; images that were measured before keep their size."""
        if "measure" in self.record["stages"]:
            return
        settings = MeasureSettings.of(self.settings)
        if (person := person_seen(self.footage, settings, monitor)) is not None:
            self.distance_m = person.distance_m
            small = self.measured_footage
            first = person.frame if self.begin is None else self.begin
            if small.full_size_px and not shows_enough(small, settings, self.results, first, monitor):
                self._measure_in_full_size()

    def _measure_in_full_size(self) -> None:
        self.in_full_size = True
        self.warn(IN_FULL_SIZE)

    @property
    def clouds(self) -> Sequence[PointCloud]:
        """The clouds in the order of time, as the user corrected them; without points where nothing was measured."""
        return self.measured.clouds(self.corrected) if self.measured else empty_clouds(self.footage)

    def corrected(self, cloud: PointCloud) -> PointCloud:
        """A cloud without what the user took out."""
        return corrected_cloud(cloud, self.footage.take.corrections, self.footage.rig)

    def warn(self, *sentences: str) -> None:
        """Note what the user should know."""
        self.record["warnings"].extend(s for s in dict.fromkeys(sentences) if s not in self.record["warnings"])

    def finish_stage(self, stage: str, began: float, **figures: Any) -> None:
        """Note what a stage took and found, and write run.json."""
        key = self.keys.get(stage, self.keys.get("fit", ""))
        before = self.record["stages"].get(stage, {})
        same = {name: before[name] for name in (CONTENT, STAMPED) if name in before and before.get("key") == key}
        by_content = {CONTENT: self.content_keys[stage]} if stage in self.content_keys else {}
        written = {edited_tables.ENTRY: edited_tables.digests(self.results.folder)} if stage == "fit" else {}
        entry = {"seconds": round(time.perf_counter() - began, 2), "key": key, **same, **by_content, **written, **figures}
        stages = self.record["stages"] | {stage: entry}
        self.record["stages"] = {name: stages[name] for name in MADE_BY if name in stages}  # one made again is no longer the last
        write_frame_table(self.results.path("frames.csv"), frame_table(self.measured.summaries, self.trajectories, self.body))
        self.results.write_run(self.record)

    def warn_if_replaced(self) -> None:
        """Warn where images, or other files that the surface was measured from, are no longer those with which the run began."""
        if self.replaced():
            self.warn(REPLACED)

    def note_surface(self, digest: str) -> None:
        """Drop what was made from another surface than the measured one, whose digest this is. The key of a stage has neither the content
        of images nor parts of a second of their times."""
        if self.record["stages"].get("measure", {}).get(SURFACE, digest) == digest:
            return
        after = ("track",) if self.keeps_body else STAGES[STAGES.index("measure") + 1 :]
        dropped = after if self.keeps_body else (*after, "report")
        self.record["stages"] = {name: entry for name, entry in self.record["stages"].items() if name not in dropped}
        names = [name for stage in after for name in STAGE_INPUTS[stage].files]
        kept = [] if self.keeps_body else earlier_body.keep(self.results.folder, _recorded(self.results), self.keys.get("fit", ""))
        self.notes += [OTHER_IMAGES, *kept, *_remove(self.results, [*names, *FIT_STEPS, FITTED])]

    def remove_body(self, names: Sequence[str]) -> None:
        """Remove the body's files: a finished body becomes the earlier one, and what was edited is copied to another name."""
        self.notes += edited_tables.keep(self.results.folder, self.record["stages"])
        self.notes += earlier_body.keep(self.results.folder, _recorded(self.results), self.keys.get("fit", ""))
        self.results.remove(*names, f"report/{QUESTION}")

    @contextmanager
    def resumable(self, *partial: str, stopped: Callable[[], str]) -> Iterator[None]:
        """A cancelled stage says what its checkpoints keep (`stopped`), and leaves no `partial` results; what the user is asked is noted in
        run.json, with a picture."""
        try:
            yield
        except Cancelled as stop:
            self.results.remove(*partial)
            raise Cancelled(stopped()) from stop
        except NeedsClick as question:
            with_picture = NeedsClick(question.start, self._question_shown(question.start))
            self._note_question(with_picture)
            raise with_picture from question
        except NobodyFound as question:
            self._note_question(question)
            raise

    def _note_question(self, question: InputError) -> None:
        self.record[ASKS] = str(question)
        self.results.write_run(self.record)

    def _question_shown(self, start: StartJoints) -> str:
        """Draw the pose of a start and its likeliest rival; the sentence that says so, or why there is no picture."""
        path, names = self.results.path("report", QUESTION), [view.name for view in self.footage.take.views]
        try:
            picture = question_picture(start, self.footage.rig.cameras, names, self.footage.read_whole(start.frame))
            store.write_bytes(path, png(picture))
        except InputError as fault:
            return f"There is no picture of it: {fault}"
        return f"{path} shows what was found there" + (" and the likeliest other pose." if start.rival_m else ".")

    def do_without_surface(self, why: str) -> None:
        """Note that there are no clouds and no trajectories."""
        self.surfaceless = True
        self.results.remove("clouds", "trajectories.npz", "trajectories_raw.npz", "tracked")
        for stage in ("measure", "track"):
            self.finish_stage(stage, time.perf_counter(), not_done=why)

    def __str__(self) -> str:
        """One line for a panel."""
        stages = self.record["stages"]
        parts = [f"{len(self.footage.frames)} frames"]
        if "points_per_frame" in stages.get("measure", {}):
            parts.append(f"{stages['measure']['points_per_frame']:.0f} points a frame (sigma {stages['measure']['sigma_mm']:.2f} mm)")
        if "trajectories" in stages.get("track", {}):
            parts.append(f"{stages['track']['trajectories']} trajectories")
        if "fit" in stages and "not_done" not in stages["fit"]:
            parts.append("body fitted")
        return ", ".join(parts)


@contextmanager
def open_run(
    take_folder: Path,
    out: Path,
    overrides: Overrides | None = None,
    frames: tuple[int, int] | None = None,
    *,
    restart: bool = False,
    for_contours: bool = False,
    needs_body: bool = False,
    spares: bool = False,
    pictures: Sequence[int] = (),
    clicked: Callable[[Take], Take] | None = None,
) -> Iterator[Run]:
    """Open a take and the folder for its results, into which no other run can write meanwhile. What can be checked beforehand is checked.

    What an earlier run of other input left in OUT is removed (with `for_contours` surface and tracks alone: the files of a fit stay
    until the next one); `restart` removes it all. A finished body moves to earlier_body; a body.blend that somebody edited, and an outline
    that was drawn on other images, get another name. `notes` has the sentences that say so, and so has an error that follows. `needs_body`:
    a body of the same input must be there, but for its outlines. `spares`: results of another take, or a body of frames that are left out
    now, are not removed. `pictures`: the frames of the report's, by default a few. `clicked`: gives the take with other clicks.

    Raises:
        InputError: the take, the rig, the settings or the folder need mending, or another run is at work in the folder.
    """
    take = read_take(take_folder)
    take = take if clicked is None else clicked(take)
    settings = settings_of(take.settings, overrides or {}, str(take.folder / "take.toml"))
    footage = _checked_footage(take, settings, out, frames)
    check_pictured(footage.frames, pictures)
    begun, opened = dict(settings), stage_keys(footage, settings, Path(out))["measure"]
    with Results(out).opened() as results:
        before, digests = {} if restart else results.read_run(), FileDigests()
        if for_contours:
            check_same_take(results.folder, before, take)
            _check_frames(results.folder, before, footage.frames)

        def by_content() -> dict[str, str]:
            return stage_keys(footage, settings, Path(out), digests.stamp) if reads_content(footage) else {}

        outlines, notes = _outlines(results, before, footage, digests, check=not for_contours)
        with _with_errors(notes):
            keys = _known(results, before, stage_keys(footage, settings, Path(out)), by_content)
            if spares:
                _check_not_replaced(results.folder, before, footage, keys)
            kept = _kept_stages(results, before, keys, for_contours=for_contours, needs_body=needs_body)
            record, incomplete = new_record(footage, settings) | {drawn_outlines.ENTRY: outlines}, lost(results.folder, before)
            record |= {name: before[name] for name in (blend_file.DIGESTS, films.ENTRY) if name in before}
            record["stages"] = {stage: entry for stage, entry in kept.items() if stage not in incomplete}
            if "fit" not in record["stages"]:
                notes += edited_tables.keep(results.folder, _recorded(results).get("stages", {}))
                notes += earlier_body.keep(results.folder, _recorded(results), keys["fit"])
            notes += _remove_all(results) if restart else _remove_stale(results, before, kept)
            if ASKS in before or record["stages"].keys() != before.get("stages", {}).keys():  # no word stays of what is made again
                results.write_run(record)
            body_key = stage_keys(footage, settings | {"skin": SkinSettings()}, Path(out))["fit"]
            run = Run(footage=footage, settings=settings, results=results, keys=keys, body_key=body_key, record=record, pictured=pictures)
            run.replaced = partial(_are_others, footage, begun, Path(out), opened)
            run.notes, run.digests, run.keeps_body = notes, digests, for_contours
            if not set(STAGES) <= set(record["stages"]):  # before the footage is measured: it may be replaced meanwhile
                run.content_keys = by_content()
            yield run


def _check_frames(folder: Path, before: Mapping[str, Any], frames: range) -> None:
    """Check that results in a folder are of these frames: contours of others would remove surface and tracks.

    Raises:
        InputError: they are of others.
    """
    first, end = before.get("frames", (frames.start, frames.stop))
    if before.get("stages") and (first, end) != (frames.start, frames.stop):
        raise InputError(
            f"{folder} has results of the frames {first}:{end}, and an outline is tracked in the same ones; choose these frames, or "
            "another folder for the results."
        )


def check_same_take(folder: Path, before: Mapping[str, Any], take: Take, advice: str = "choose another folder for the results.") -> None:
    """Check that results, if there are any in a folder, are of this take.

    Raises:
        InputError: they are of another one.
    """
    earlier, text = Path(before.get("take", "")), store.digest(take.folder / "take.toml")
    is_there, is_copy = (earlier / "take.toml").is_file(), before.get("inputs", {}).get("take.toml") == text
    if before and earlier != take.folder and is_there and not is_copy:  # a take that was moved is no longer there
        raise InputError(f"{folder} has {'the fitted body' if _has_body(before) else 'results'} of another take, {earlier}; {advice}")


def _has_body(before: Mapping[str, Any]) -> bool:
    stages = before.get("stages", {})
    return "fit" in stages and "not_done" not in stages["fit"]


def _check_not_replaced(folder: Path, before: Mapping[str, Any], footage: Footage, keys: Mapping[str, str]) -> None:
    """Check that results are not replaced by those of another take, nor a finished body by that of frames that lack some of its own.

    Raises:
        InputError: it would be.
    """
    take, now = footage.take, footage.frames
    if not before or "measure" in valid_stages(before, keys):
        return
    advice = "choose another folder for the results, or replace them with --restart."
    check_same_take(folder, before, take, advice)
    first, end = before.get("frames", (now.start, now.stop))
    if _has_body(before) and before.get("interlaced") == take.interlaced and not now.start <= first < end <= now.stop:
        raise InputError(f"{folder} has the fitted body of the frames {first}:{end}; for {now.start}:{now.stop} {advice}")


def _kept_stages(
    results: Results, before: Mapping[str, Any], keys: Mapping[str, str], *, for_contours: bool, needs_body: bool
) -> dict[str, Any]:
    """The stages of an earlier run whose files stay: those of the same input, and for contours also a fit that is out of date.

    Raises:
        InputError: a body of the same input is needed, and there is none.
    """
    valid = valid_stages(before, keys, ignore_contours=for_contours)
    if needs_body and ("fit" not in valid or not any(files_of(results.path("skin"), "skin"))):
        raise InputError(f"{results.folder} has no fitted body with a skin for these frames and settings; run `tricap fit` first.")
    earlier = before.get("stages", {}) if for_contours else {}
    return {name: earlier[name] for name in ("fit", "report") if name in earlier} | valid


def _outlines(
    results: Results, before: dict[str, Any], footage: Footage, digests: FileDigests, *, check: bool
) -> tuple[dict[str, drawn_outlines.Drawn], list[str]]:
    """What run.json is to note of the outlines in the folder; one that was drawn on other images is set aside, and sentences say so.
    `check`: that the others can be read. Outlines stay where a run begins anew."""
    before = before or _recorded(results)
    found = drawn_outlines.outlines_in(results.folder, before, footage, digests)
    if check:
        drawn_outlines.check_tables(results.folder, [*found.current])
    notes = [drawn_outlines.set_aside(results.folder, view) for view in found.outdated]
    if before and before.get(drawn_outlines.ENTRY, {}) != found.current:
        before[drawn_outlines.ENTRY] = found.current
        store.write_json(results.path("run.json"), before)
    return found.current, notes


def _recorded(results: Results) -> dict[str, Any]:
    """run.json as it is; empty where it is missing or damaged, which a run that begins anew replaces."""
    try:
        return results.read_run()
    except InputError:
        return {}


def _checked_footage(take: Take, settings: Mapping[str, Any], out: Path, frames: tuple[int, int] | None) -> Footage:
    """The footage of a take, or only some frames of it, with what can be checked before a run."""
    footage = open_take(take, click_sigma_px=settings["fitting"].click_sigma_px)
    if frames is not None:
        footage = only_frames(footage, frames)
    for name, at in take.clicks.joints.items():
        clicked_depth(footage, name, at)
    if take.joints_model is not None:
        read_model(take.joints_model)
        check_body(footage, settings["fitting"])
    check_separate_folder(out, take.folder, (path for s in footage.sequences for path in s.files()))
    return footage


def _are_others(footage: Footage, settings: Mapping[str, Any], out: Path, key: str) -> bool:
    """Whether the files that the surface is measured from are no longer those of this key."""
    try:
        return stage_keys(footage, settings, out)["measure"] != key
    except InputError:
        return True


def _known(results: Results, run: dict[str, Any], keys: dict[str, str], by_content: Callable[[], dict[str, str]]) -> dict[str, str]:
    """`known_keys`; a copy of the files that is found to be the same is noted in run.json, so that its content is read only once."""
    known = known_keys(keys, run, by_content)
    found = [stage for stage in known if known[stage] != keys[stage] and run["stages"][stage].get(STAMPED) != keys[stage]]
    for stage in found:
        run["stages"][stage][STAMPED] = keys[stage]
    if found:
        store.write_json(results.path("run.json"), run)
    return known


def _remove_all(results: Results) -> list[str]:
    """Remove the results and checkpoints of earlier runs; see `_remove`. The cache comes last: it marks the folder as ours."""
    return _remove(results, [blend_file.BLEND, "run.json", "clouds", *STAGE_FILES, "cache"])


def _remove_stale(results: Results, before: Mapping[str, Any], kept: Mapping[str, Any]) -> list[str]:
    """Remove the results of stages that are not kept: what was made otherwise must not stand beside the new. See `_remove`."""
    return _remove(results, [name for stage, own in STAGE_INPUTS.items() if before and stage not in kept for name in own.files])


def _remove(results: Results, names: Sequence[str]) -> list[str]:
    """Remove results. A body.blend with edits gets another name instead; the sentence that says so.

    Raises:
        InputError: a film may be the user's; then nothing is removed. Or something cannot be removed.
    """
    films.check_ours(results.folder, _recorded(results), {*names}.intersection(films.FILMS))
    kept = blend_file.keep_edited(results.folder) if blend_file.BLEND in names else ""
    results.remove(*names)
    return [kept] if kept else []


@contextmanager
def _with_errors(notes: Sequence[str]) -> Iterator[None]:
    """Add the notes to an error or a stop: nobody else would show them then."""
    try:
        yield
    except (InputError, Cancelled) as stop:
        for note in notes:
            stop.add_note(note)
        raise


def only_frames(footage: Footage, frames: tuple[int, int]) -> Footage:
    """The footage with only these frames, half-open.

    Raises:
        InputError: the take has not all of them.
    """
    if frames[0] not in footage.frames or frames[1] - 1 not in footage.frames or frames[0] >= frames[1]:
        raise InputError(
            f"Frames {frames[0]}:{frames[1]} are not among the take's frames {footage.frames.start}:{footage.frames.stop}; choose others."
        )
    return replace(footage, frames=range(*frames))
