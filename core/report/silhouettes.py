"""Agreement of the fitted body's silhouette with the person's, view by view and frame by frame.

    IoU = |body ∩ person| / |body ∪ person|        of a whole body                                          (1)
    inside = |body ∩ person| / |body|              of a part of a body, such as an arm                      (2)

The person is the region within the outline that `tricap contour` tracked, or else what covers the still background.
An outline has no holes, so those of the body (between an arm and the trunk) are filled too. The distance is that of the person's outline
from the nearest point of the body's, the median over the outline.

The silhouette of a part can be compared with the person's only where the part is: the rest of the person is missing from the model, so
that neither (1) nor the distance of the outlines measures the fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from ..body.motion import BodyFit
from ..body.skeleton import Skeleton
from ..fitting.inputs.fit_input import BackgroundDistances
from ..fitting.inputs.no_surface import filled
from ..foundation.progress import Monitor
from ..foundation.threads import in_threads
from ..geometry.camera import Camera
from ..geometry.raster import rasterize
from ..take.footage import Footage
from .person import Mesh, SkinAt

OUTLINE, BACKGROUND = "outline", "background"
MOST_FRAMES = {OUTLINE: 60, BACKGROUND: 10}  # evenly over the take
TOGETHER = 4  # frames whose silhouettes are in memory at once
PERSON = {OUTLINE: "the person's outline", BACKGROUND: "the person in front of the background"}  # by source
WHOLE_BODY = frozenset({"head", "forearm.L", "forearm.R", "shin.L", "shin.R"})  # bones; a model without one of them is a part of a body


@dataclass(frozen=True, kw_only=True, slots=True)
class SilhouetteFit:
    """The agreement in one view and frame. NaN: not comparable."""

    view: str
    frame: int
    iou: float  # (1) of a whole body
    inside: float  # (2) of a part of a body
    distance_px: float  # of a whole body
    person: str  # source of the person's silhouette: "outline" or "background"

    @property
    def overlap(self) -> float:
        """(1) of a whole body, (2) of a part."""
        return self.inside if np.isnan(self.iou) else self.iou


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Silhouettes:
    """The agreement wherever the person's silhouette is known, and the outlines (V, 2) px of `tricap contour` by view and frame.

    `whole`: the body is a whole one, not a part such as an arm.
    """

    whole: bool = True
    fits: tuple[SilhouetteFit, ...] = ()
    outlines: Mapping[str, Mapping[int, np.ndarray]] = field(default_factory=dict)


def silhouettes_of(
    footage: Footage,
    body: BodyFit,
    skin_at: SkinAt | None,
    outlines: Mapping[str, Mapping[int, np.ndarray]],
    backgrounds: Sequence[BackgroundDistances],
    monitor: Monitor,
) -> Silhouettes:
    """The agreement of the body's skin with the outlines, and in views without one with the regions that cover the still background.

    Nothing is compared for a body without a skin.

    Raises:
        Cancelled: the user asked to stop.
    """
    frames, whole = body.motion.frames, is_whole_body(body.shape.skeleton)
    most = MOST_FRAMES[OUTLINE if outlines else BACKGROUND]
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))
    if skin_at is None or (not outlines and not backgrounds):
        return Silhouettes(whole=whole)
    found, regions = list[SilhouetteFit](), {r.view: r for r in backgrounds}

    def masks_at(i: int) -> list[np.ndarray]:
        return [] if monitor.cancelled else body_masks(footage.rig.cameras, skin_at(body.motion.values[i]))

    together = [chosen[n : n + TOGETHER] for n in range(0, len(chosen), TOGETHER)]
    masked = ((int(i), masks) for some in together for i, masks in zip(some, in_threads(masks_at, some.tolist())))
    for n, (i, masks) in enumerate(masked):
        monitor.step("silhouettes", n, len(chosen))
        frame = int(frames[i])
        for camera, mask in zip(footage.rig.cameras, masks):
            polygon = outlines.get(camera.name, {}).get(frame)
            if polygon is not None:
                person, source = filled(polygon, camera.size_px), OUTLINE
            elif camera.name in regions and (shown := person_mask(regions[camera.name], frame, camera.size_px)) is not None:
                person, source = shown, BACKGROUND
            else:
                continue
            iou, inside, distance = overlap(mask, person, whole=whole)
            found.append(SilhouetteFit(view=camera.name, frame=frame, iou=iou, inside=inside, distance_px=distance, person=source))
    return Silhouettes(whole=whole, fits=tuple(found), outlines=outlines)


def is_whole_body(skeleton: Skeleton) -> bool:
    """Whether a body has all limbs and a head, so that its silhouette is the person's."""
    return {bone.name for bone in skeleton.bones} >= WHOLE_BODY


def by_view(fits: Sequence[SilhouetteFit]) -> dict[str, dict[str, float]]:
    """The median and least overlap and the median distance of each view, for run.json; frames without a silhouette are left out."""
    table: dict[str, dict[str, float]] = {}
    for view in dict.fromkeys(f.view for f in fits):
        mine = [f for f in fits if f.view == view]
        whole, part = [f for f in mine if np.isfinite(f.iou) and np.isfinite(f.distance_px)], [f for f in mine if np.isfinite(f.inside)]
        if whole:
            iou, distance = [f.iou for f in whole], [f.distance_px for f in whole]
            table[view] = {
                "iou": round(float(np.median(iou)), 4),
                "least_iou": round(min(iou), 4),
                "distance_px": round(float(np.median(distance)), 3),
                "frames": len(whole),
            }
        elif part:
            inside = [f.inside for f in part]
            table[view] = {"inside": round(float(np.median(inside)), 4), "least_inside": round(min(inside), 4), "frames": len(part)}
    return table


def body_masks(cameras: Sequence[Camera], skin: Mesh) -> list[np.ndarray]:
    """The silhouette of a skin in each camera (h, w), holes filled."""
    masks = []
    for camera in cameras:
        raster = rasterize(camera, skin.vertices_m, skin.triangles, back_faces=True)
        masks.append(_filled_holes(raster.image(np.ones(len(raster.sample)), 0.0) > 0))
    return masks


def outlines_of(mask: np.ndarray) -> list[np.ndarray]:
    """The closed outlines (M, 2) px about a mask (h, w)."""
    return [c[:, 0] for c in cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]]


def person_mask(regions: BackgroundDistances, frame: int, size_px: tuple[int, int]) -> np.ndarray | None:
    """The person (h, w) in front of the still background of a view; None where nothing is known of it."""
    distance = regions.of_frame(frame)
    if distance is None or not distance.any() or distance.all():
        return None
    small, (w, h) = (distance == 0).astype(np.uint8), (n * regions.step_px for n in distance.shape[::-1])
    mask = np.zeros(size_px[::-1], bool)
    mask[:h, :w] = cv2.resize(small, (w, h), interpolation=cv2.INTER_NEAREST)[: size_px[1], : size_px[0]] > 0
    return _filled_holes(mask)


def overlap(body: np.ndarray, person: np.ndarray, *, whole: bool) -> tuple[float, float, float]:
    """(1), (2) and the distance [px] of the outlines of two masks (h, w); NaN for those that do not apply to a whole body, or to a part."""
    common = int((body & person).sum())
    if not whole:
        area = int(body.sum())
        return np.nan, common / area if area and person.any() else np.nan, np.nan
    union = int((body | person).sum())
    return common / union if union else np.nan, np.nan, _distance_px(body, person)


def _distance_px(body: np.ndarray, person: np.ndarray) -> float:
    """Median distance of the person's largest outline from the nearest point of the body's; NaN if one has none."""
    edge = np.ones(body.shape, np.uint8)
    for outline in outlines_of(body):
        edge[outline[:, 1], outline[:, 0]] = 0
    outlines = outlines_of(person)
    if not outlines or edge.all():
        return np.nan
    distance = cv2.distanceTransform(edge, cv2.DIST_L2, cv2.DIST_MASK_5)
    largest = max(outlines, key=len)
    return float(np.median(distance[largest[:, 1], largest[:, 0]]))


def _filled_holes(mask: np.ndarray) -> np.ndarray:
    whole = np.zeros(mask.shape, np.uint8)
    for outline in cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
        cv2.drawContours(whole, [outline], -1, 1, cv2.FILLED)
    return whole > 0
