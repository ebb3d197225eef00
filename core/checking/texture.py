"""What clothes allow, before anything is matched: parts of the person with too little texture, and how precise the surface will be.

The best sigma that matching could reach is the Cramér–Rao bound of a shift between two equally noisy images, less the gradients of the
noise itself, over the n pixels of a patch:

    S = Σ ∇f ∇fᵀ − n σ_∇² I ,   σ_px = √2 σ_noise / √λ_min(S)                     (1)

A surface at the distance z of a camera with the camera constant f, and others B_k beside it, then has the precision

    σ_z = z² / (f √ΣB_k²) · √(σ_px² + σ_0²)                                        (2)

with σ_0 for what a patch on a curved body leaves over with the best texture. In 22 recordings with known surface, the median error
of the points was 0.6 to 1.2 times the one that follows from (2), with clicks or without.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np

from ..body.model_file import read_model
from ..foundation.errors import InputError
from ..geometry.intersection import intersect_clicks
from ..images.sampling import noise_sigma
from ..matching.least_squares import MatchingSettings
from ..take.clicked_points import clicked_depth
from ..take.footage import Footage
from .findings import Cause, Finding, doubtful, remark, wrong
from .view_matches import match_views

GRADIENT_NOISE = 0.5  # variance of a central difference of noise of variance 1
LEAST_NOISE = 0.3  # grey values: rounding alone
POOR_SHARE = 0.5  # of the positions along a limb
ALONG = (0.15, 0.85)  # part of a limb, from joint to joint
SAMPLES = 24  # positions along a limb
MOVES = 3.0  # times the noise: a pixel that changes by more is moving
BLUR_PX = 9  # side of the window in which changes are averaged
FEWEST_MOVING = 50  # pixels
MOST_MOVING = 5000  # pixels that are evaluated, about
TEXTURED_SHARE = 1e-3  # of an image without texture, at most
PATCH_PX = 0.045  # σ_0 of (2)
MEDIAN = 0.6745  # of the size of an error, over its sigma
PLAIN_PX, PLAIN_MM = 0.07, 1.2  # the bound and the median error of plain clothes, on which the surface has holes, are larger
PATTERN_PX = 0.03  # the bound of printed cloth
CLOSER = 2 / 3  # of the distance, that is advised
AGREES_PX = 3.0  # between the rays of two matches
FEWEST_DEPTHS = 5  # of matches, for a distance
EVERYTHING = "what moves"
PARTS = {"upper_arm": "arm", "forearm": "arm", "hand": "arm", "thigh": "leg", "shin": "leg", "foot": "leg"}
SIDES = {"R": "right", "L": "left"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Clothes:
    """The bounds (1) of the person's parts in the reference view, in the frame of the clicks or the first one."""

    view: str
    frame: int
    bound_px: Mapping[str, float]  # the median of each bone between clicked joints, or of what moves; inf where it is lost in the noise
    mm_per_px: float  # of (2), in depth; NaN where the distance of the person is not known
    max_sigma_px: float  # of a match, that is allowed
    is_blank: bool = False  # there is no texture anywhere

    @staticmethod
    def of(footage: Footage, matching: MatchingSettings) -> "Clothes":
        """Those of an opened take.

        Raises:
            InputError: an image cannot be read.
        """
        take, ref = footage.take, footage.take.reference
        frame = take.clicks.frame if take.clicks.frame in footage.frames else footage.frames.start
        images = [take.rows_at(frame).rows(image) for image in footage.read(frame)]
        bound = bound_px(images[ref], matching.patch_px, take.rows_at(frame).step)
        blank = not np.isfinite(bound).any() or bool(np.mean(bound < matching.max_sigma_px) < TEXTURED_SHARE)
        parts = {} if blank else _limbs(footage, take.views[ref].name) or _moving(footage, images[ref], frame)
        return Clothes(
            view=take.views[ref].name,
            frame=frame,
            bound_px={name: _median_at(bound, xy) for name, xy in parts.items()},
            mm_per_px=_mm_per_px(footage, _distance_m(footage, images, frame, parts)),
            max_sigma_px=matching.max_sigma_px,
            is_blank=blank,
        )

    def findings(self) -> list[Finding]:
        """Parts with too little texture, and a remark on the precision to expect."""
        if self.is_blank:
            sentence = f"View {self.view} has no texture in frame {self.frame}: nothing in it can be matched."
            advice = "Wear clothes with a fine pattern, and focus the cameras on the person."
            return [wrong(Cause.NO_TEXTURE, sentence, advice, frame=self.frame)]
        poor = [
            doubtful(
                Cause.WEAK_TEXTURE,
                f"The texture of {name} is too poor in view {self.view}: "
                + (f"a match there has a sigma of {value:.2g} px at best" if np.isfinite(value) else "it is lost in the noise")
                + f" ({self.max_sigma_px:g} px is allowed).",
                "Wear a pattern there, or use more light; or try --set matching.patch_px=21.",
                bound_px=value if np.isfinite(value) else None,
                limit_px=self.max_sigma_px,
            )
            for name, value in self.bound_px.items()
            if value > self.max_sigma_px
        ]
        return [*poor, *self._expected()]

    def figures(self) -> dict[str, object]:
        """The bounds, and the expected precision of each part."""
        finite = {name: value for name, value in self.bound_px.items() if np.isfinite(value)}
        return {"texture_bound_px": finite, "expected_mm": {name: round(self._median_mm(b), 2) for name, b in self._parts().items()}}

    def _parts(self) -> dict[str, float]:
        """The median bound of the trunk and of each limb, where they and the distance are known."""
        together: dict[str, list[float]] = {}
        for bone, bound in self.bound_px.items():
            name, _, side = bone.partition(".")
            part = f"{SIDES[side]} {PARTS[name]}" if name in PARTS and side in SIDES else bone if bone == EVERYTHING else "trunk and head"
            together.setdefault(part, []).append(bound)
        medians = {part: float(np.median(bounds)) for part, bounds in together.items()}
        return {part: bound for part, bound in medians.items() if np.isfinite(bound * self.mm_per_px)}

    def _median_mm(self, bound: float, share: float = 1.0) -> float:
        """The median error that follows from a bound by (2), at a share of the distance."""
        return MEDIAN * self.mm_per_px * share**2 * float(np.hypot(bound, PATCH_PX))

    def _expected(self) -> list[Finding]:
        """The precision to expect of each part, and where it is poor, what would help by how much."""
        parts = self._parts()
        if not parts:
            return []
        precise: dict[str, list[str]] = {}
        for part, bound in sorted(parts.items(), key=lambda item: item[1]):
            precise.setdefault(f"{self._median_mm(bound):.1f} mm", []).append(part)
        said = [*precise] if len(precise) == 1 else [f"{mm} ({', '.join(names)})" for mm, names in precise.items()]
        sentence = f"By the texture, half of the measured points should be within {', '.join(said)} of the surface."
        plain = [bound for bound in parts.values() if bound > PLAIN_PX and self._median_mm(bound) > PLAIN_MM]
        if not plain:
            return [remark(Cause.CLOTHES, sentence)]
        usual = float(np.median(plain))
        better = {
            "a pattern": self._median_mm(PATTERN_PX),
            "half the noise (more light)": self._median_mm(usual / 2),
            "two thirds of the distance": self._median_mm(usual, CLOSER),
        }
        helps = ", ".join(f"{way} to {mm:.1f} mm" for way, mm in better.items())
        advice = f"Clothes so plain leave holes in the surface, and few points to track. What would help: {helps}."
        return [remark(Cause.CLOTHES, sentence, advice)]


def bound_px(grey: np.ndarray, patch_px: int, row_step: int) -> np.ndarray:
    """Smallest sigma [px] (h, w) of a match at each pixel of the measured rows; inf where there is only noise.  (1)"""
    noise = max(noise_sigma(grey), LEAST_NOISE)
    gx = cv2.filter2D(grey, cv2.CV_32F, np.array([[-0.5, 0.0, 0.5]], np.float32))
    gy = cv2.filter2D(grey, cv2.CV_32F, np.array([[-0.5], [0.0], [0.5]], np.float32))
    size = (patch_px, max(3, patch_px // row_step))
    n = size[0] * size[1]
    xx, yy, xy = (n * cv2.blur(a * b, size).astype(np.float64) for a, b in ((gx, gx), (gy, gy), (gx, gy)))
    smallest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy) - n * GRADIENT_NOISE * noise**2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(smallest > 0, np.sqrt(2.0) * noise / np.sqrt(np.maximum(smallest, 1e-12)), np.inf)


def _limbs(footage: Footage, view: str) -> Mapping[str, np.ndarray]:
    """Pixels (n, 2) of the measured rows along each bone whose two joints are clicked in the reference view."""
    take = footage.take
    if take.joints_model is None:
        return {}
    clicked = {name: at[view] for name, at in take.clicks.joints.items() if view in at}
    t = np.linspace(*ALONG, SAMPLES)[:, None]
    bones = read_model(take.joints_model).skeleton.bones
    return {
        b.name: take.rows_at(take.clicks.frame).from_frame(clicked[b.head_joint] * (1 - t) + clicked[b.tail_joint] * t)
        for b in bones
        if b.head_joint in clicked and b.tail_joint in clicked
    }


def _moving(footage: Footage, grey: np.ndarray, frame: int) -> Mapping[str, np.ndarray]:
    """Pixels (n, 2) of what moves: they are different in the first and in the last frame, so that a background that was covered there is
    left out. Of frames at an end, a middle one is compared, too."""
    frames = footage.frames
    others = sorted({frames[0], frames[len(frames) // 2], frames[-1]} - {frame}, key=lambda f: -abs(f - frame))[:2]
    moves = np.ones(grey.shape, dtype=bool)
    for other in others:
        later = footage.take.rows_at(other).rows(footage.read(other)[footage.take.reference])
        difference = cv2.blur(np.abs((grey - np.median(grey)) - (later - np.median(later))), (BLUR_PX, BLUR_PX))
        moves &= difference > MOVES * max(1.0, noise_sigma(grey))
    y, x = np.nonzero(moves & bool(others))
    return {EVERYTHING: np.stack([x, y], axis=1)[:: max(1, len(x) // MOST_MOVING)]} if len(x) > FEWEST_MOVING else {}


def _median_at(bound: np.ndarray, xy: np.ndarray) -> float:
    inside = (xy >= 0).all(axis=1) & (xy <= np.array(bound.shape[::-1]) - 1).all(axis=1)
    at = np.rint(xy[inside]).astype(int)
    values = bound[at[:, 1], at[:, 0]]
    return float(np.quantile(values, POOR_SHARE, method="higher")) if len(values) else 0.0


def _distance_m(footage: Footage, images: list[np.ndarray], frame: int, parts: Mapping[str, np.ndarray]) -> float:
    """How far the person is from the reference camera: by the clicks, or by matches on what moves; NaN where neither says."""
    take, cameras = footage.take, footage.rig.cameras
    clicked = list[float]()
    for name, at in take.clicks.joints.items():
        with suppress(InputError):  # clicks that contradict each other have a finding of their own
            clicked.append(clicked_depth(footage, name, at))
    if clicked:
        return float(np.median(clicked))
    if EVERYTHING not in parts:
        return float("nan")
    rows, depths = take.rows_at(frame), list[np.ndarray]()
    person = np.zeros(images[take.reference].shape, dtype=np.uint8)
    person[parts[EVERYTHING][:, 1], parts[EVERYTHING][:, 0]] = 1
    person = cv2.dilate(person, np.ones((BLUR_PX, BLUR_PX), np.uint8))
    for pair in match_views([images], rows):
        if take.reference in (pair.i, pair.j):
            here = rows.from_frame(pair.xi_px if pair.i == take.reference else pair.xj_px)
            at = np.clip(np.rint(here).astype(int), 0, np.array(person.shape[::-1]) - 1)
            both = pair.agreeing(cameras, AGREES_PX) & (person[at[:, 1], at[:, 0]] > 0)
            found = intersect_clicks([cameras[pair.i], cameras[pair.j]], np.stack([pair.xi_px[both], pair.xj_px[both]], axis=1))
            depths.append(cameras[take.reference].to_camera(found.xyz_m)[:, 2])
    known = np.concatenate([np.zeros(0), *depths])
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) >= FEWEST_DEPTHS else float("nan")


def _mm_per_px(footage: Footage, distance_m: float) -> float:
    """The error in depth [mm] of a match that is wrong by a pixel in all views.  (2)"""
    cameras, ref = footage.rig.cameras, footage.take.reference
    aside = [cameras[ref].to_camera(camera.centre_m[None])[0, :2] for k, camera in enumerate(cameras) if k != ref]
    base = float(np.linalg.norm(aside))
    return 1e3 * distance_m**2 / (cameras[ref].focal_px * base) if base > 0 else float("nan")
