"""`tricap check TAKE`: the footage, its timing, its texture, and whether the rig belongs to it."""

import math
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..matching.least_squares import MatchingSettings
from ..progress import Monitor
from ..settings import from_table
from ..take import Footage, open_take, read_take
from .clicks import joint_findings, seed_findings
from .findings import Checked, Finding, doubtful, wrong
from .rig_check import geometry_findings, unit_findings
from .rig_fit import ENOUGH, clicked_pairs, rig_findings, rig_misses, same_views, share, stale_finding
from .survey import frozen_view, picture_findings, rate_findings, survey
from .texture import texture_findings
from .timing import Film, TimeOffset, estimate_offsets
from .view_matches import match_views

DOUBTFUL_RESIDUAL_PX = 1.0
FROZEN_FRAMES = 3
FEWEST_BESIDE = 4  # frames on either side of a step
STEP, STEP_PX = 2.0, 0.05  # sound takes: medians of two parts differ by a twelfth at most
SMALL = 0.05  # frames: not worth an interpolation
SPARE = 0.25  # frames: an offset beyond it spoils a measurement
UNUSABLE = ("blank view", "frozen view", "identical views", "swapped views", "foreign rig", "no texture")  # after them, timing says nothing


def check_take(folder: Path, monitor: Monitor) -> Checked:
    """Everything that can be said of a take before it is measured; seconds for a short clip.

    What cannot even be opened is a finding too.
    """
    try:
        footage = open_take(read_take(folder))
        findings, figures = check_footage(footage, monitor)
        findings += joint_findings(footage.take)
    except InputError as error:
        findings, figures = [wrong("input", str(error))], {}
    return Checked(subject=str(folder), kind="take", findings=tuple(findings), figures=figures)


def check_footage(footage: Footage, monitor: Monitor) -> tuple[list[Finding], dict[str, object]]:
    """The findings about an opened take, and the figures behind them.

    Raises:
        InputError: an image cannot be read.
    """
    footage = footage.single()
    names = tuple(v.name for v in footage.take.views)
    matching = from_table(MatchingSettings, footage.take.settings.get("matching", {}), "[matching]")
    film = Film(footage, survey(footage, monitor))
    found = [*geometry_findings(footage.rig), *picture_findings(film.seen, names), *rate_findings(footage)]
    pairs = film.matches()
    alike = same_views(pairs, names)
    weak, bounds = texture_findings(footage, matching.patch_px, matching.max_sigma_px)
    found += alike or rig_findings(pairs, clicked_pairs(footage.take), footage.rig.cameras, names)
    found += [*weak, *seed_findings(footage)]
    figures: dict[str, object] = {
        "frames": len(footage.frames),
        "matches": {f"{names[p.i]}-{names[p.j]}": len(p.xi_px) for p in pairs},
        "agreeing_share": round(share(pairs, footage.rig.cameras), 4),
        "texture_bound_px": bounds,
    }
    if not any(f.cause in UNUSABLE for f in found):
        offsets = estimate_offsets(footage, monitor, film)
        lonely = [n for k, n in enumerate(names) if max(len(p.xi_px) for p in pairs if k in (p.i, p.j)) < ENOUGH]
        found += [_lonely(name) for name in lonely]
        found += [timing_finding(o) for o in offsets if o.doubtful]
        found += [rolling_finding(o) for o in offsets if o.rolls]
        without_time = rig_misses(pairs, footage.rig.cameras, names)  # for views whose offset in time cannot be estimated
        misses = {o.view: o.miss_px if math.isfinite(o.miss_px) else without_time.get(o.view, 0.0) for o in offsets if not o.doubtful}
        found += stale_finding(misses | {o.view: o.miss_px for o in offsets if o.doubtful and math.isfinite(o.miss_px)})
        figures["offsets"] = {o.view: o.to_table() for o in offsets}
    return found, figures


def causes_of_failure(footage: Footage, monitor: Monitor) -> list[Finding]:
    """Why a take could not be measured, or only badly, what is certain first.

    Raises:
        InputError: an image cannot be read.
    """
    return sorted(check_footage(footage, monitor)[0], key=lambda finding: not finding.certain)


def doubts(footage: Footage, frames: list[int], points: list[int], miss_px: list[float], monitor: Monitor) -> list[str]:
    """What is odd about measured clouds, in sentences, and the causes: frames without points, rays that miss by much (the median of
    each frame), or by more from some frame on.

    Every run has a look at its first frame; one with odd figures is checked throughout.
    """
    empty = [frame for frame, n in zip(frames, points) if not n]
    there = [(frame, miss) for frame, n, miss in zip(frames, points, miss_px) if n and math.isfinite(miss)]
    residual_px = float(np.median([miss for _, miss in there])) if there else 0.0
    said = [f"No surface was found in {len(empty)} frame(s), the first is {empty[0]}."] if empty else []
    if residual_px > DOUBTFUL_RESIDUAL_PX:
        said.append(
            f"The rays of matched points miss each other by {residual_px:.1f} px: "
            "does rig.toml belong to this recording, and were the views in step?"
        )
    said += sudden_step([frame for frame, _ in there], np.array([miss for _, miss in there]))
    causes = causes_of_failure(footage, monitor) if said else [*first_look(footage, frames[0]), *rate_findings(footage)]
    return said + [f"{cause.sentence} {cause.advice}".strip() for cause in causes]


def sudden_step(frames: list[int], miss_px: np.ndarray) -> list[str]:
    """A sentence where the rays' misses (T,) jump in some frame and stay: a view lost a frame there, or a camera was moved.

    The frame is the one whose two sides differ most in their mean logarithm, by what the numbers on either side let it weigh.
    """
    if len(frames) < 2 * FEWEST_BESIDE or not (miss_px > 0).all():
        return []
    log, n = np.log(miss_px), np.arange(1, len(frames))
    sums = np.cumsum(log)
    apart = (sums[-1] - sums[:-1]) / (len(log) - n) - sums[:-1] / n
    weight = np.abs(apart) * np.sqrt(n * (len(log) - n))
    weight[: FEWEST_BESIDE - 1] = weight[len(weight) - FEWEST_BESIDE + 1 :] = 0
    at = int(np.argmax(weight)) + 1
    before, after = float(np.median(miss_px[:at])), float(np.median(miss_px[at:]))
    if max(before, after) < STEP * min(before, after) or abs(after - before) < STEP_PX:
        return []
    return [
        f"From frame {frames[at]} on the rays of matched points miss each other by {after:.2g} px, before by {before:.2g} px: "
        "a view may have lost or doubled a frame there, or a camera was moved; compare the views around it, run the parts apart (--frames)."
    ]


def first_look(footage: Footage, frame: int) -> list[Finding]:
    """Views that are identical, swapped or frozen, or a rig of another recording, from the first frames: a second's work in every run.

    Raises:
        InputError: an image cannot be read.
    """
    names, rows = tuple(v.name for v in footage.take.views), footage.take.rows_at(frame)
    pictures = footage.read(frame)
    still = still_views(footage, frame, pictures)
    pairs = match_views([[rows.rows(image) for image in pictures]], rows)
    beside = [*unit_findings(footage.rig), *(frozen_view(name) for name in still)]
    return same_views(pairs, names) or [*beside, *rig_findings(pairs, clicked_pairs(footage.take), footage.rig.cameras, names)]


def still_views(footage: Footage, frame: int, pictures: list[np.ndarray]) -> list[str]:
    """Views of which a few frames after `frame` have its very picture, noise and all, while those of another view differ."""
    names, step = [v.name for v in footage.take.views], footage.take.field_layout.per_image
    after = [f for f in (frame + n * step for n in range(1, FROZEN_FRAMES)) if f in footage.frames]
    same = np.ones(len(names), dtype=bool)
    for f in after:
        same &= [np.array_equal(a, b) for a, b in zip(pictures, footage.read(f))]
    return [name for name, stood in zip(names, same) if stood] if len(after) == FROZEN_FRAMES - 1 and not same.all() else []


def with_cause(error: InputError, footage: Footage, frame: int) -> InputError:
    """What is certainly wrong with the footage instead of what came of it, where there is such a thing."""
    cause = next((finding for finding in first_look(footage, frame) if finding.certain), None)
    return error if cause is None else InputError(f"{cause.sentence} {cause.advice}".strip())


def timing_finding(offset: TimeOffset) -> Finding:
    """What to do about a view that is early or late."""
    late, sigma = offset.delay_frames, offset.sigma_frames
    word = "later" if late > 0 else "earlier"
    steps = [f"add {-round(late):+d} to `offset_frames` of view {offset.view} in take.toml"] if round(late) else []
    if abs(late - round(late)) > SMALL:
        steps.append("set `correct = true` under [settings.timing], which puts its pictures to the others' moment")
    advice = " and ".join(steps or ["measure it as it is"]) + "; or synchronize the cameras."
    advice = advice[0].upper() + advice[1:]
    if offset.method == "energy":
        return doubtful(
            "out of step",
            f"View {offset.view} seems to be {abs(late):.0f} frames {word} than the reference view, going by when how much moves.",
            f"Compare the views at a sudden movement. If it is so: {advice[0].lower()}{advice[1:]}",
            **offset.to_table(),
        )
    return (wrong if abs(late) > SPARE else doubtful)(
        "out of step",
        f"View {offset.view} is {abs(late):.2f} ± {sigma:.2g} frames {word} than the reference view; "
        f"the rays of moving points miss by up to {offset.effect_px:.1f} px.",
        advice,
        **offset.to_table(),
    )


def rolling_finding(offset: TimeOffset) -> Finding:
    """What to do about a view whose rows are exposed one after the other, otherwise than the reference view's."""
    r, word = offset.readout_frames, "longer" if offset.readout_frames > 0 else "shorter"
    return doubtful(
        "rolling shutter",
        f"View {offset.view} takes {abs(r):.2f} ± {offset.readout_sigma:.2g} frames {word} from its first row to its last than the "
        f"reference view (rolling shutter); the rays of moving points there miss by up to {offset.rolling_px:.1f} px.",
        "Use a mode that reads the sensor faster, or cameras of one kind, held level; what moves fast is best kept at middle height.",
        readout_frames=r,
        readout_sigma_frames=offset.readout_sigma,
    )


def _lonely(name: str) -> Finding:
    return doubtful(
        "nothing in common",
        f"View {name} has almost nothing in common with any other view.",
        "Neighbouring cameras should stand at most 30° apart, look at the same place and show it in like size.",
    )
