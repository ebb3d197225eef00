"""Where the cloth has too little texture to be measured: the sigma that matching could reach at best, before anything is matched.

    S = Σ ∇f ∇fᵀ − n σ_∇² I ,   σ_px = √2 σ_noise / √λ_min(S)                     (1)

over the pixels of a patch: the Cramér–Rao bound of a shift between two equally noisy pictures, the noise's own gradients taken off.
"""

from collections.abc import Mapping

import cv2
import numpy as np

from ..body.model_file import read_model
from ..images.sampling import noise_sigma
from ..take import Footage
from .findings import Finding, doubtful, wrong

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
    frame = take.seeds.frame if take.seeds.frame in footage.frames else footage.frames.start
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
    clicked = {name: at[view] for name, at in take.seeds.joints.items() if view in at}
    t = np.linspace(*ALONG, SAMPLES)[:, None]
    bones = read_model(take.body_model).skeleton.bones
    return {
        b.name: take.rows_at(take.seeds.frame).from_frame(clicked[b.head_joint] * (1 - t) + clicked[b.tail_joint] * t)
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
