"""How well the fitted body's silhouette agrees with the person's, view by view and frame by frame.

    IoU = |body ∩ person| / |body ∪ person|                                                                (1)

The person is what lies within the outline that `tricap contour` found, or else the largest region that hides the still background.
An outline has no holes, so those of the body (between an arm and the trunk) are filled too. The distance is that of the person's outline
from the nearest point of the body's, the median over the outline.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from ..body.ends import shape_for_skin
from ..body.shape import BodyShape
from ..body.skin import SkinSettings, body_skin
from ..errors import InputError
from ..fitting.body_motion import BodyFit
from ..geometry.camera import Camera
from ..geometry.raster import rasterize
from ..images.background import WINDOW_PX, Background
from ..progress import Monitor
from ..take import Footage
from ..without_surface import filled

OUTLINE, BACKGROUND = "outline", "background"
MOST_FRAMES = {OUTLINE: 60, BACKGROUND: 10}  # evenly over the take: a frame of four views takes a third of a second


@dataclass(frozen=True, kw_only=True, slots=True)
class SilhouetteFit:
    """The agreement in one view and frame."""

    view: str
    frame: int
    iou: float
    distance_px: float
    person: str  # what tells where the person is: "outline" or "background"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Silhouettes:
    """The agreement wherever the person's silhouette is known, and the outlines (V, 2) px of `tricap contour` by view and frame."""

    fits: tuple[SilhouetteFit, ...] = ()
    outlines: Mapping[str, Mapping[int, np.ndarray]] = field(default_factory=dict)


def silhouettes_of(
    footage: Footage,
    body: BodyFit,
    settings: SkinSettings,
    outlines: Mapping[str, Mapping[int, np.ndarray]],
    backgrounds: Mapping[str, Background],
    monitor: Monitor,
) -> Silhouettes:
    """The agreement of the body with the outlines, and in views without one with what hides the still background.

    Raises:
        Cancelled: the user asked to stop.
    """
    frames = body.motion.frames
    most = MOST_FRAMES[OUTLINE if outlines else BACKGROUND]
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))
    if not outlines and not backgrounds:
        return Silhouettes()
    found = []
    for n, i in enumerate(chosen.tolist()):
        monitor.step("silhouettes", n, len(chosen))
        frame = int(frames[i])
        images = footage.read(frame) if backgrounds else [None] * len(footage.rig.cameras)
        masks = body_masks(footage.rig.cameras, body.shape, body.motion.values[i], settings)
        for camera, mask, image in zip(footage.rig.cameras, masks, images):
            polygon = outlines.get(camera.name, {}).get(frame)
            if polygon is not None:
                found.append(_agreement(camera.name, frame, mask, filled(polygon, camera.size_px), OUTLINE))
            elif camera.name in backgrounds and image is not None:
                found.append(_agreement(camera.name, frame, mask, _before(backgrounds[camera.name], image), BACKGROUND))
    return Silhouettes(fits=tuple(found), outlines=outlines)


def by_view(fits: Sequence[SilhouetteFit]) -> dict[str, dict[str, float]]:
    """The median and least IoU and the median distance of each view, for run.json; frames without a silhouette are passed over."""
    table: dict[str, dict[str, float]] = {}
    known = [f for f in fits if np.isfinite(f.iou) and np.isfinite(f.distance_px)]
    for view in dict.fromkeys(f.view for f in known):
        mine = [f for f in known if f.view == view]
        iou, distance = [f.iou for f in mine], [f.distance_px for f in mine]
        table[view] = {
            "iou": round(float(np.median(iou)), 4),
            "least_iou": round(min(iou), 4),
            "distance_px": round(float(np.median(distance)), 3),
            "frames": len(mine),
        }
    return table


def body_masks(cameras: Sequence[Camera], shape: BodyShape, values: np.ndarray, settings: SkinSettings) -> list[np.ndarray]:
    """What each camera shows of a body (h, w), holes filled; nothing of a body without a skin."""
    try:
        skin = body_skin(shape_for_skin(shape, settings), values, settings)
    except InputError:
        return [np.zeros(camera.size_px[::-1], bool) for camera in cameras]
    masks = []
    for camera in cameras:
        raster = rasterize(camera, skin.vertices_m, skin.triangles, back_faces=True)
        masks.append(_filled_holes(raster.image(np.ones(len(raster.sample)), 0.0) > 0))
    return masks


def outlines_of(mask: np.ndarray) -> list[np.ndarray]:
    """The closed outlines (M, 2) px about a mask (h, w)."""
    return [c[:, 0] for c in cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]]


def _before(background: Background, image: np.ndarray) -> np.ndarray:
    """The largest region (h, w) of an image that hides the background, without the rim that the comparison in windows adds."""
    hides = cv2.erode((~background.shown_by(image)).astype(np.uint8), np.ones((WINDOW_PX // 2 * 2 + 1,) * 2, np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(hides)
    return _filled_holes(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))) if len(stats) > 1 else hides > 0


def _agreement(view: str, frame: int, body: np.ndarray, person: np.ndarray, source: str) -> SilhouetteFit:
    union = int((body | person).sum())
    distance = np.nan
    edge = np.ones(body.shape, np.uint8)
    for outline in outlines_of(body):
        edge[outline[:, 1], outline[:, 0]] = 0
    seen = outlines_of(person)
    if seen and not edge.all():
        far = cv2.distanceTransform(edge, cv2.DIST_L2, cv2.DIST_MASK_5)
        largest = max(seen, key=len)
        distance = float(np.median(far[largest[:, 1], largest[:, 0]]))
    return SilhouetteFit(
        view=view, frame=frame, iou=float((body & person).sum() / union) if union else np.nan, distance_px=distance, person=source
    )


def _filled_holes(mask: np.ndarray) -> np.ndarray:
    whole = np.zeros(mask.shape, np.uint8)
    for outline in cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
        cv2.drawContours(whole, [outline], -1, 1, cv2.FILLED)
    return whole > 0
