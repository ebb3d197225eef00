"""`tricap check TAKE`: the footage, its timing, its texture, and whether the rig belongs to it.

Clicks that are missing, contradict each other, or lie on the room instead of the person. What the clothes allow is in `texture`.
"""

import math
from pathlib import Path

import numpy as np

from ..body.model_file import read_model
from ..fitting.inputs.take_inputs import clicks_of_no_joint
from ..fitting.settings import FitSettings
from ..foundation.bounded import real_path
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import from_table
from ..geometry.robust import finite_median
from ..geometry.view_angles import no_view_alike
from ..images.combing import Combing, combing
from ..matching.foreground import unchanged
from ..matching.least_squares import MatchingSettings
from ..take.clicked_points import clicked_depth
from ..take.footage import Footage, open_take
from ..take.take import START_ALONE, Take, read_take
from ..tracking.corrections import odd_regions
from .findings import Cause, Checked, Finding, doubtful, remark, wrong
from .openings import opening_findings
from .rig_check import (
    FEWEST_MATCHES,
    agreeing_share,
    clicked_pairs,
    geometry_findings,
    moved_findings,
    rig_distances,
    rig_findings,
    same_views,
    stale_finding,
    wide_findings,
)
from .survey import frozen_view, gap_findings, picture_findings, rate_findings, survey
from .texture import Clothes
from .timing import Film, TimeOffset, estimate_offsets
from .view_matches import eight_bits, match_views

FAR_M = 1.0  # in depth: more than the reach of a stretched-out arm

LIMBS = {f"{side} {limb}": tuple(f"{joint}.{side[0].upper()}" for joint in joints) for side in ("right", "left")
         for limb, joints in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle")))}  # fmt: skip


def joint_findings(take: Take) -> list[Finding]:
    """A limb without clicks: clicks decide which way the fit bends it. A whole person starts by itself. Clicks that the body does not have,
    and those in one view.

    Raises:
        InputError: there is no such body model.
    """
    foreign = [remark(Cause.CLICKS, sentence) for sentence in clicks_of_no_joint(take)]
    if flat := [f"{name} (frame {key.frame})" for key in take.keyframes for name, at in key.joints.items() if len(at) == 1]:
        sentence = f"Clicked in one view only: {', '.join(flat)}. That does not show how far away the joint is."
        foreign.append(remark(Cause.FEW_CLICKS, sentence, "Click it in a second view, too."))
    if take.joints_model is None or take.keypoints:
        return foreign
    joints = read_model(take.joints_model).skeleton.joint_names
    clicked = {name for frame in (take.clicks, *take.keyframes) for name, at in frame.joints.items() if len(at) > 1}
    advice = "Click them in Blender (step 3), or write them under [seeds.joints] of take.toml, in two views at least."
    if not clicked and take.body_model in START_ALONE:
        return foreign
    if not clicked:
        sentence = (
            f"No joint of the body “{take.body_model}” is clicked. It starts by itself only where the whole person is visible; "
            "otherwise the result will have surface and tracks, but no body."
        )
        return [*foreign, doubtful(Cause.NO_CLICKS, sentence, advice)]
    bare = [limb for limb, names in LIMBS.items() if {*names} <= {*joints} and len(clicked & {*names}) < 2]
    only_limbs = {*joints} <= {"toe.R", "toe.L"}.union(*LIMBS.values())  # the body is no person
    missing = [name for names in LIMBS.values() if only_limbs and {*names} <= {*joints} for name in names if name not in clicked]
    if not bare and missing:
        sentence = f"Not clicked in two views: {', '.join(missing)}. The fit has to find where the limb ends or bends."
        return [*foreign, remark(Cause.FEW_CLICKS, sentence, advice)]
    if not bare:
        return foreign
    sentence = f"Fewer than two joints are clicked of: {', '.join(bare)}. The fit has to find their pose."
    return [*foreign, doubtful(Cause.FEW_CLICKS, sentence, advice)]


def seed_findings(footage: Footage) -> list[Finding]:
    """Clicks whose rays do not meet, clicks at another depth than the others, and surface seeds on what never moves."""
    clicks, findings, depth = footage.take.clicks, [], dict[str, float]()
    for name, at in clicks.named:
        try:
            depth[name] = clicked_depth(footage, name, at)
        except InputError as error:
            findings.append(wrong(Cause.CLICKS, str(error)))
    middle = finite_median([*depth.values()], 0.0)
    far = {name: d for name, d in depth.items() if abs(d - middle) > FAR_M}
    for name, d in far.items():
        advice = "Is it on the background, or clicked on different spots in the views? Click it again."
        findings.append(
            doubtful(Cause.CLICKS, f"The click “{name}” is {abs(d - middle):.1f} m away from the others in depth.", advice, depth_m=d)
        )
    static = [i for i in _static_seeds(footage) if f"surface seed {i + 1}" not in far]
    if static:
        numbers = ", ".join(str(i + 1) for i in static)
        advice = "Is it on the background? The range of depths that is measured follows the clicks; click it on the person."
        findings.append(doubtful(Cause.SEED_ON_BACKGROUND, f"Surface seed {numbers} lies on something that never moves.", advice))
    return findings


def _static_seeds(footage: Footage) -> list[int]:
    """Surface seeds (their numbers from 0) around which the reference image is the same in the frame furthest in time."""
    take, name = footage.take, footage.take.reference_view
    frame = take.clicks.frame
    clicked = [i for i, at in enumerate(take.clicks.surface) if name in at]
    other = max(footage.frames, key=lambda f: abs(f - frame))
    if not clicked or other == frame:
        return []
    here, later = (take.rows_at(f).rows(footage.read(f)[take.reference]) for f in (frame, other))
    xy = take.rows_at(frame).from_frame(np.array([take.clicks.surface[i][name] for i in clicked]))
    xy = np.clip(xy, 0, np.array(here.shape[::-1]) - 1)
    return [i for i, same in zip(clicked, unchanged(here, later, xy)) if same]


DOUBTFUL_RESIDUAL_PX = 1.0  # median distance between the rays of matched points
FROZEN_FRAMES = 3  # that are compared
FEWEST_BESIDE = 4  # frames on either side of a step
FEW_POINTS = 100  # of a frame: their number varies by chance
SUDDENLY = 0.7  # of the points of the frames beside it: something is wrong with its images
STEP_RATIO = 2.0  # of the medians before and after it; in sound takes those of two parts differ by a twelfth at most
STEP_PX = 0.05  # between these medians
SMALL = 0.05  # frames: not worth an interpolation
SPOILS = 0.25  # frames: a larger offset spoils a measurement
COMBED_FRAMES = 4  # in which combing is looked for
UNUSABLE = (  # footage with which time offsets cannot be estimated
    Cause.BLANK_VIEW,
    Cause.FROZEN_VIEW,
    Cause.IDENTICAL_VIEWS,
    Cause.SWAPPED_VIEWS,
    Cause.FOREIGN_RIG,
    Cause.NO_TEXTURE,
)


def check_take(folder: Path, monitor: Monitor) -> Checked:
    """All checks of a take before it is measured; a few seconds for a short clip. A take that cannot be opened is a finding, too."""
    try:
        take = read_take(folder)
        fitting = from_table(FitSettings, take.settings.get("fitting", {}), "[fitting]")
        footage = open_take(take, click_sigma_px=fitting.click_sigma_px)
        findings, figures = check_footage(footage, monitor)
        findings += [*joint_findings(footage.take), *opening_findings(footage, fitting, monitor)]
    except InputError as error:
        findings, figures = [wrong(Cause.INPUT, str(error))], {}
    notes = tuple(str(finding) for finding in findings if finding.harmless)
    harmful = tuple(finding for finding in findings if not finding.harmless)
    return Checked(subject=str(folder), kind="take", findings=harmful, figures=figures, notes=notes)


def check_footage(footage: Footage, monitor: Monitor) -> tuple[list[Finding], dict[str, object]]:
    """The findings about an opened take, and the figures behind them.

    Raises:
        InputError: an image cannot be read.
    """
    footage = footage.single()
    names = tuple(v.name for v in footage.take.views)
    matching = from_table(MatchingSettings, footage.take.settings.get("matching", {}), "[matching]")
    film = Film(footage, survey(footage, monitor))
    fitting = from_table(FitSettings, footage.take.settings.get("fitting", {}), "[fitting]")
    wide = wide_findings(footage.rig.cameras, footage.take.reference) if fitting.use_surface else []
    odd = odd_regions(footage.take.corrections, footage.rig)
    findings = [
        *geometry_findings(footage.rig),
        *wide,
        *(doubtful(Cause.CLICKS, sentence, "See [[corrections]] in take.toml.") for sentence in odd),
        *_own_backgrounds(footage),
        *([remark(Cause.REFERENCE_VIEW, footage.reference_note)] if footage.reference_note else []),
        *picture_findings(film.survey, names),
        *rate_findings(footage),
        *gap_findings(footage),
    ]
    pairs = film.matches()
    identical = same_views(pairs, names)
    clothes = Clothes.of(footage, matching)
    findings += identical or rig_findings(pairs, clicked_pairs(footage.take), footage.rig.cameras, names, footage.click_sigma_px)
    combed = film_combing(film) if footage.take.interlaced == "none" else None
    matched = fitting.use_surface and not no_view_alike(footage.rig.cameras, footage.take.reference)
    findings += [*combing_findings(combed), *(clothes.findings() if matched else []), *seed_findings(footage)]
    figures: dict[str, object] = {
        "frames": len(footage.frames),
        "matches": {f"{names[p.i]}-{names[p.j]}": len(p.xi_px) for p in pairs},
        "agreeing_share": round(agreeing_share(pairs, footage.rig.cameras), 4),
        **(clothes.figures() if matched else {}),
    }
    if not any(f.cause in UNUSABLE for f in findings):
        offsets = estimate_offsets(footage, monitor, film)
        unmatched = [n for k, n in enumerate(names) if max(len(p.xi_px) for p in pairs if k in (p.i, p.j)) < FEWEST_MATCHES]
        findings += [_unmatched(name) for name in unmatched]
        findings += [timing_finding(o) for o in offsets if o.doubtful]
        findings += [rolling_finding(o) for o in offsets if o.rolls]
        without_time = rig_distances(pairs, footage.rig.cameras, names)  # for views whose time offset cannot be estimated
        distance = {o.view: without_time[o.view] for o in offsets if o.view in without_time and not o.doubtful}
        findings += stale_finding(distance | {o.view: o.distance_px for o in offsets if math.isfinite(o.distance_px)})
        if not any(o.doubtful for o in offsets):
            findings += moved_findings(pairs, footage.rig.cameras, names)
        figures["offsets"] = {o.view: o.to_table() for o in offsets}
    return findings, figures


def film_combing(film: Film) -> Combing:
    """The combing of the images in which most moves, all views together."""
    views = film.footage.sequences
    numbers = [(k, film.footage.number(k, t)) for t in film.frames()[:COMBED_FRAMES] for k in range(len(views)) if film.has(k, t + 1)]
    return combing([(eight_bits(views[k].read(n)), eight_bits(views[k].read(n + 1))) for k, n in numbers])


def combing_findings(combed: Combing | None) -> list[Finding]:
    """Interlaced footage that is measured as progressive."""
    if combed is None or not combed.found:
        return []
    return [
        wrong(
            Cause.COMBING,
            f"Combing was found where something moves ({combed.ratio:.1f} times as much between neighbouring rows as between rows of one "
            "field): the footage is interlaced.",
            'Set `interlaced = "both"` in take.toml' + (f' and `first_field = "{combed.first}"`.' if combed.first else "."),
            ratio=combed.ratio,
            first_field=combed.first,
        )
    ]


def causes_of_failure(footage: Footage, monitor: Monitor) -> list[Finding]:
    """Why a take could not be measured, or only poorly; certain findings first.

    Raises:
        InputError: an image cannot be read.
    """
    harmful = [finding for finding in check_footage(footage, monitor)[0] if not finding.harmless]
    return sorted(harmful, key=lambda finding: not finding.certain)


def check_clouds(footage: Footage, frames: list[int], points: list[int], residual_px: list[float], monitor: Monitor) -> list[str]:
    """Warnings about measured clouds, and the causes: frames without points or with much fewer than those beside them, rays that miss each
    other by much (`residual_px` is the median of each frame), or by more from some frame on.

    Every run checks its first frame; a run with such warnings checks the whole take.
    """
    empty = [frame for frame, n in zip(frames, points) if not n]
    measured = [(frame, px) for frame, n, px in zip(frames, points, residual_px) if n and math.isfinite(px)]
    usual_px = finite_median([px for _, px in measured], 0.0)
    warnings = [f"No surface was found in {len(empty)} frame(s), the first is {empty[0]}."] if empty else []
    if usual_px > DOUBTFUL_RESIDUAL_PX:
        warnings.append(
            f"The rays of matched points miss each other by {usual_px:.1f} px: "
            "does rig.toml belong to this recording, and were the cameras synchronised?"
        )
    warnings += sudden_gaps(frames, np.array(points, dtype=np.float64))
    warnings += sudden_step([frame for frame, _ in measured], np.array([px for _, px in measured]))
    causes = causes_of_failure(footage, monitor) if warnings else [*check_first_frame(footage, frames[0]), *rate_findings(footage)]
    return warnings + [f"{cause.sentence} {cause.advice}".strip() for cause in causes]


def sudden_gaps(frames: list[int], points: np.ndarray) -> list[str]:
    """A warning where one or two frames have much fewer points (T,) than those before and after them. Decoders fill what is damaged in a
    picture with grey, and say nothing; where nothing is damaged, no frame of the recordings tried had less than 0.84 of its neighbours'."""
    beside = [min(points[max(0, t - 2) : t].max(), points[t + 1 : t + 3].max()) for t in range(1, len(points) - 1)]
    few = [t for t, usual in enumerate(beside, 1) if usual > FEW_POINTS and points[t] < SUDDENLY * usual]
    if not few:
        return []
    t, more = few[0], f" (and {len(few) - 1} more frames likewise)" if len(few) > 1 else ""
    return [
        f"Frame {frames[t]} has {points[t]:.0f} measured points, and the frames beside it up to {beside[t - 1]:.0f}{more}: look at its "
        "images in all views; one may be damaged, or of another moment."
    ]


def sudden_step(frames: list[int], residual_px: np.ndarray) -> list[str]:
    """A warning where the residuals (T,) jump in some frame and stay: a view lost a frame there, or a camera was moved.

    The frame is the one before and after which the mean logarithms differ most, weighted by the numbers of frames on both sides.
    """
    if len(frames) < 2 * FEWEST_BESIDE or not (residual_px > 0).all():
        return []
    log, n = np.log(residual_px), np.arange(1, len(frames))
    sums = np.cumsum(log)
    difference = (sums[-1] - sums[:-1]) / (len(log) - n) - sums[:-1] / n
    weight = np.abs(difference) * np.sqrt(n * (len(log) - n))
    weight[: FEWEST_BESIDE - 1] = weight[len(weight) - FEWEST_BESIDE + 1 :] = 0
    at = int(np.argmax(weight)) + 1
    before, after = float(np.median(residual_px[:at])), float(np.median(residual_px[at:]))
    if max(before, after) < STEP_RATIO * min(before, after) or abs(after - before) < STEP_PX:
        return []
    return [
        f"From frame {frames[at]} on, the rays of matched points miss each other by {after:.2g} px, before by {before:.2g} px: a view may "
        "have lost or doubled a frame there, or a camera was moved. Compare the views around it, and run both parts separately (--frames)."
    ]


def _own_backgrounds(footage: Footage) -> list[Finding]:
    """A finding for each background that is an image of its own view: whoever it shows counts as background."""
    advice, findings = "That is right if it shows nobody; otherwise take an image of the empty room.", []
    for view, sequence in zip(footage.take.views, footage.sequences):
        if view.background and real_path(footage.take.folder / view.background) in map(real_path, sequence.files()):
            what = f"The background of view {view.name}, {view.background}, is an image of this view"
            findings.append(doubtful(Cause.BACKGROUND, f"{what}: whoever it shows counts as background.", advice))
    return findings


def check_first_frame(footage: Footage, frame: int) -> list[Finding]:
    """Views that are identical, swapped or frozen, a rig that is impossible or of another recording, or a camera that was moved or
    refocused, from the first frames: about a second in every run.

    Raises:
        InputError: an image cannot be read.
    """
    names, rows = tuple(v.name for v in footage.take.views), footage.take.rows_at(frame)
    images = footage.read(frame)
    frozen = [frozen_view(name) for name in frozen_views(footage, frame, images)]
    pairs = match_views([[rows.rows(image) for image in images]], rows)
    return same_views(pairs, names) or [
        *geometry_findings(footage.rig),
        *frozen,
        *(
            rig_findings(pairs, clicked_pairs(footage.take), footage.rig.cameras, names, footage.click_sigma_px)
            or moved_findings(pairs, footage.rig.cameras, names)
        ),
    ]


def frozen_views(footage: Footage, frame: int, images: list[np.ndarray]) -> list[str]:
    """Views whose next frames repeat the image of `frame` exactly, noise included, while those of another view differ."""
    names, step = [v.name for v in footage.take.views], footage.take.field_layout.per_image
    after = [f for f in (frame + n * step for n in range(1, FROZEN_FRAMES)) if f in footage.frames]
    same = np.ones(len(names), dtype=bool)
    for f in after:
        repeats = [footage.number(k, f) == footage.number(k, frame) for k in range(len(names))]  # of a view with fewer images per second
        same &= [np.array_equal(a, b) and not again for a, b, again in zip(images, footage.read(f), repeats)]
    return [name for name, frozen in zip(names, same) if frozen] if len(after) == FROZEN_FRAMES - 1 and not same.all() else []


def with_cause(error: InputError, footage: Footage, frame: int) -> InputError:
    """A certain fault of the footage instead of its consequence, `error`; `error` where there is none."""
    cause = next((finding for finding in check_first_frame(footage, frame) if finding.certain), None)
    return error if cause is None else InputError(f"{cause.sentence} {cause.advice}".strip())


def timing_finding(offset: TimeOffset) -> Finding:
    """A view that is not synchronised, and what to do about it."""
    delay, sigma = offset.delay_frames, offset.sigma_frames
    word = "later" if delay > 0 else "earlier"
    steps = [f"add {-round(delay):+d} to `offset_frames` of view {offset.view} in take.toml"] if round(delay) else []
    if abs(delay - round(delay)) > SMALL:
        steps.append("use --set timing.correct=true, which interpolates its images to the moment of the others")
    advice = " and ".join(steps or ["measure it as it is"]) + "; or synchronize the cameras."
    advice = advice[0].upper() + advice[1:]
    if offset.method == "energy":
        return doubtful(
            Cause.NOT_SYNCHRONISED,
            f"View {offset.view} seems to be {abs(delay):.0f} frames {word} than the reference view, judging by the amount of motion only.",
            f"Compare the views at a sudden movement. If that is right: {advice[0].lower()}{advice[1:]}",
            view=offset.view,
            **offset.to_table(),
        )
    return (wrong if abs(delay) > SPOILS else doubtful)(
        Cause.NOT_SYNCHRONISED,
        f"View {offset.view} is {abs(delay):.2f} ± {sigma:.2g} frames {word} than the reference view; "
        f"the rays of moving points miss by up to {offset.effect_px:.1f} px.",
        advice,
        view=offset.view,
        **offset.to_table(),
    )


def rolling_finding(offset: TimeOffset) -> Finding:
    """A view whose rolling shutter differs from the reference view's, and what to do about it."""
    r, word = offset.readout_frames, "longer" if offset.readout_frames > 0 else "shorter"
    return doubtful(
        Cause.ROLLING_SHUTTER,
        f"The rolling shutter of view {offset.view} takes {abs(r):.2f} ± {offset.readout_sigma:.2g} frames {word} from first to last "
        f"row than that of the reference view; the rays of moving points there miss by up to {offset.rolling_px:.1f} px.",
        "Give the `readout` of the views in take.toml, in seconds from the first row to the last (only the difference is measured here), "
        "use a mode that reads the sensor faster, or cameras of one kind, held level.",
        readout_frames=r,
        readout_sigma_frames=offset.readout_sigma,
    )


def _unmatched(name: str) -> Finding:
    return doubtful(
        Cause.NO_MATCHES,
        f"View {name} has almost no matches in any other view.",
        "Neighbouring cameras should be at most 30° apart, look at the same place and show it at a similar size.",
    )
