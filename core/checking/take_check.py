"""`tricap check TAKE`: the footage, its timing, its texture, and whether the rig belongs to it.

Clicks that are missing, contradict each other or lie on the room instead of the person.

Where the cloth has too little texture to be measured: the sigma that matching could reach at best, before anything is matched.

    S = Σ ∇f ∇fᵀ − n σ_∇² I ,   σ_px = √2 σ_noise / √λ_min(S)                     (1)

over the pixels of a patch: the Cramér–Rao bound of a shift between two equally noisy pictures, the noise's own gradients taken off.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from ..body.model_file import read_model
from ..fitting.settings import FitSettings
from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import from_table
from ..geometry.robust import finite_median
from ..images.sampling import noise_sigma
from ..matching.foreground import unchanged
from ..matching.least_squares import MatchingSettings
from ..take.clicked_points import clicked_depth
from ..take.take import Footage, Take, open_take, read_take
from .findings import Checked, Finding, doubtful, wrong
from .rig_check import ENOUGH, clicked_pairs, geometry_findings, rig_findings, rig_misses, same_views, share, stale_finding, unit_findings
from .survey import frozen_view, picture_findings, rate_findings, survey
from .timing import Film, TimeOffset, estimate_offsets
from .view_matches import match_views

FAR_M = 1.0  # in depth: more than a stretched-out arm reaches from the body

LIMBS = {f"{side} {limb}": tuple(f"{joint}.{side[0].upper()}" for joint in joints) for side in ("right", "left")
         for limb, joints in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle")))}  # fmt: skip


def joint_findings(take: Take) -> list[Finding]:
    """A body that is wanted and not clicked, or limbs of it: which way a limb goes is what the fit takes from clicks.

    Raises:
        InputError: there is no such body model.
    """
    if take.body_model is None or take.keypoints:
        return []
    joints = read_model(take.body_model).skeleton.joint_names
    clicked = {name for frame in (take.clicks, *take.keyframes) for name, at in frame.joints.items() if len(at) > 1}
    advice = "Click them in Blender (step 3), or write them under [seeds.joints] of take.toml, in two views at least."
    if not clicked:
        sentence = f"No joint of the body “{take.body_model}” is clicked: there will be surface and tracks, but no body."
        return [doubtful("no clicks", sentence, advice)]
    bare = [limb for limb, names in LIMBS.items() if {*names} <= {*joints} and len(clicked & {*names}) < 2]
    if not bare:
        return []
    said = ", ".join(bare)
    return [doubtful("few clicks", f"Fewer than two joints are clicked of: {said}. The fit has to guess where they are.", advice)]


def seed_findings(footage: Footage) -> list[Finding]:
    """Clicks without a place in space, far behind the others, or surface seeds on what never moves."""
    clicks, found, depth = footage.take.clicks, [], dict[str, float]()
    for name, at in clicks.named:
        try:
            depth[name] = clicked_depth(footage, name, at)
        except InputError as error:
            found.append(wrong("clicks", str(error)))
    middle = finite_median([*depth.values()], 0.0)
    far = {name: d for name, d in depth.items() if abs(d - middle) > FAR_M}
    for name, d in far.items():
        advice = "Is it on the background, or clicked on different spots in the views? Click it again."
        found.append(doubtful("clicks", f"The click “{name}” is {abs(d - middle):.1f} m away from the others in depth.", advice, depth_m=d))
    rest = [i for i in _resting(footage) if f"surface seed {i + 1}" not in far]
    if rest:
        said = ", ".join(str(i + 1) for i in rest)
        advice = "Is it on the background? What is measured is taken from the clicks' depths; click it on the person."
        found.append(doubtful("seed on the background", f"Surface seed {said} lies on something that never moves.", advice))
    return found


def _resting(footage: Footage) -> list[int]:
    """Surface seeds (their numbers from 0) around which the reference picture is the same in the frame furthest in time."""
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


GRADIENT_NOISE = 0.5  # variance of a central difference of noise of variance 1
LEAST_NOISE = 0.3  # grey values: rounding alone
POOR_SHARE = 0.5  # of the places of a limb
ALONG = (0.15, 0.85)  # of a limb, from joint to joint
SAMPLES = 24
MOVES = 3.0  # times the noise


def bound_px(grey: np.ndarray, patch_px: int, row_step: int) -> np.ndarray:
    """Smallest sigma [px] (h, w) of a match at each pixel of the measured rows; inf where the noise is all there is.  (1)"""
    noise = max(noise_sigma(grey), LEAST_NOISE)
    gx = cv2.filter2D(grey, cv2.CV_32F, np.array([[-0.5, 0.0, 0.5]], np.float32))
    gy = cv2.filter2D(grey, cv2.CV_32F, np.array([[-0.5], [0.0], [0.5]], np.float32))
    size = (patch_px, max(3, patch_px // row_step))
    n = size[0] * size[1]
    xx, yy, xy = (n * cv2.blur(a * b, size).astype(np.float64) for a, b in ((gx, gx), (gy, gy), (gx, gy)))
    smallest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy) - n * GRADIENT_NOISE * noise**2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(smallest > 0, np.sqrt(2.0) * noise / np.sqrt(np.maximum(smallest, 1e-12)), np.inf)


def texture_findings(footage: Footage, patch_px: int, max_sigma_px: float) -> tuple[list[Finding], dict[str, float]]:
    """Limbs between clicked joints, or what moves, with too little texture in the reference view; and the median bound [px] of each."""
    take, ref = footage.take, footage.take.reference
    frame = take.clicks.frame if take.clicks.frame in footage.frames else footage.frames.start
    grey = take.rows_at(frame).rows(footage.read(frame)[ref])
    bound = bound_px(grey, patch_px, take.rows_at(frame).step)
    view = take.views[ref].name
    if not np.isfinite(bound).any() or np.mean(bound < max_sigma_px) < 1e-3:
        return [
            wrong(
                "no texture",
                f"View {view} has no texture in frame {frame}: nothing in it can be matched.",
                "Wear clothes with a fine pattern, and focus the cameras on the person.",
                frame=frame,
            )
        ], {}
    places = _limbs(footage, view) or _moving(footage, grey, frame)
    medians = {name: _median_at(bound, xy) for name, xy in places.items()}
    found = [
        doubtful(
            "weak texture",
            f"The texture of {name} is too poor in view {view}: "
            + (f"a match there has a sigma of {value:.2g} px at best" if np.isfinite(value) else "it drowns in the noise")
            + f" ({max_sigma_px:g} px is allowed).",
            "Wear a pattern there, or more light; or try --set matching.patch_px=21.",
            bound_px=value if np.isfinite(value) else None,
            limit_px=max_sigma_px,
        )
        for name, value in medians.items()
        if value > max_sigma_px
    ]
    return found, {name: value for name, value in medians.items() if np.isfinite(value)}


def _limbs(footage: Footage, view: str) -> Mapping[str, np.ndarray]:
    """Pixels (n, 2) of the measured rows along each bone whose two joints are clicked in the reference view."""
    take = footage.take
    if take.body_model is None:
        return {}
    clicked = {name: at[view] for name, at in take.clicks.joints.items() if view in at}
    t = np.linspace(*ALONG, SAMPLES)[:, None]
    bones = read_model(take.body_model).skeleton.bones
    return {
        b.name: take.rows_at(take.clicks.frame).from_frame(clicked[b.head_joint] * (1 - t) + clicked[b.tail_joint] * t)
        for b in bones
        if b.head_joint in clicked and b.tail_joint in clicked
    }


def _moving(footage: Footage, grey: np.ndarray, frame: int) -> Mapping[str, np.ndarray]:
    """Pixels (n, 2) of what moved until the frame furthest in time."""
    other = max(footage.frames, key=lambda f: abs(f - frame))
    later = footage.take.rows_at(other).rows(footage.read(other)[footage.take.reference])
    difference = cv2.blur(np.abs((grey - np.median(grey)) - (later - np.median(later))), (9, 9))
    y, x = np.nonzero(difference > MOVES * max(1.0, noise_sigma(grey)))
    return {"what moves": np.stack([x, y], axis=1)[:: max(1, len(x) // 5000)]} if len(x) > 50 else {}


def _median_at(bound: np.ndarray, xy: np.ndarray) -> float:
    inside = (xy >= 0).all(axis=1) & (xy <= np.array(bound.shape[::-1]) - 1).all(axis=1)
    at = np.rint(xy[inside]).astype(int)
    values = bound[at[:, 1], at[:, 0]]
    return float(np.quantile(values, POOR_SHARE, method="higher")) if len(values) else 0.0


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
        take = read_take(folder)
        fitting = from_table(FitSettings, take.settings.get("fitting", {}), "[fitting]")
        footage = open_take(take, click_sigma_px=fitting.click_sigma_px)
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
    found += alike or rig_findings(pairs, clicked_pairs(footage.take), footage.rig.cameras, names, footage.click_sigma_px)
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
    residual_px = finite_median([miss for _, miss in there], 0.0)
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
    return same_views(pairs, names) or [
        *beside,
        *rig_findings(pairs, clicked_pairs(footage.take), footage.rig.cameras, names, footage.click_sigma_px),
    ]


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
