"""What masks, backgrounds and corrections leave to be measured, and what a body rests on that has no surface: where that is nothing, a run
ends with an error that names the clicks or the rig.

Places where the person may be are tried in place of measured points: about the bones between clicked joints, or at all depths of the
reference image. The silhouettes and the corrections are applied to them as a run applies these to its points.
"""

import numpy as np

from ..fitting.inputs.background import find_background
from ..fitting.inputs.no_surface import can_show_outlines, empty_clouds
from ..fitting.inputs.silhouettes import PersonOutlines
from ..fitting.inputs.take_inputs import ClickedBody, clicked_body
from ..fitting.settings import FitSettings
from ..foundation.progress import Monitor
from ..foundation.settings import from_table
from ..geometry.view_angles import no_view_alike
from ..matching.foreground import Foreground, Silhouette
from ..matching.region_growing import GrowingSettings
from ..surface.beginning import other_frames
from ..surface.starts import first_frame
from ..take.footage import Footage
from ..take.person_masks import silhouette_sources, silhouettes
from ..tracking.corrections import in_regions
from .findings import Cause, Finding, doubtful

ABOUT_M = 0.15  # from the line between two joints: no limb is thicker
PLACES = 20_000  # about the bones
PIXELS, DEPTHS = 3000, 250  # of the reference image, and depths on the ray of each
BASES = (0.3, 100.0)  # of these depths, over the longest base
RANDOM_SEED = 1998


def place_findings(footage: Footage, fitting: FitSettings, monitor: Monitor) -> list[Finding]:
    """A doubt where nothing is left to be measured or, of a clicked body, nothing near its joints.

    Raises:
        InputError: an image, a mask or a background cannot be read.
        Cancelled: the user asked to stop.
    """
    body = clicked_body(footage, fitting)
    if not fitting.use_surface or no_view_alike(footage.rig.cameras, footage.take.reference):
        return _without_surface(footage, fitting, body.frame, monitor) if body is not None and body.begins else []
    growing = from_table(GrowingSettings, footage.take.settings.get("growing", {}), "[growing]")
    nowhere = _nowhere(footage, growing, monitor)
    return nowhere or (_not_at_clicks(footage, fitting, growing, body) if body is not None else [])


def _without_surface(footage: Footage, fitting: FitSettings, frame: int, monitor: Monitor) -> list[Finding]:
    """A doubt where no view has an outline of the person in the frame of the clicks."""
    if can_show_outlines(footage, fitting):
        row = footage.frames.index(frame)
        regions = find_background(footage, empty_clouds(footage), monitor, [row])
        if any(PersonOutlines(regions=region).of_frame(frame) is not None for region in regions):
            return []
    sentence = (
        f"No surface is measured, and the take shows no outline of the person in frame {frame} and has no keypoints: a body "
        "needs one of them."
    )
    advice = "Draw outlines with `tricap contour` into the folder of the run before it, or give `masks`, a `background` or [[keypoints]]."
    return [
        doubtful(Cause.INPUT, sentence, advice + " Otherwise set use_surface = true under [settings.fitting]." * (not fitting.use_surface))
    ]


def _not_at_clicks(footage: Footage, fitting: FitSettings, growing: GrowingSettings, body: ClickedBody) -> list[Finding]:
    """A doubt where what is left about the clicked bones has fewer points than one limb needs."""
    found = silhouettes(footage, _rows(footage, body.frame), body.frame, first=False)
    regions = any(c.kind == "region" and body.frame in c.frames for c in footage.take.corrections)
    if not found and not regions:
        return []
    places, camera = _about(body), footage.rig.cameras[footage.take.reference]
    xy = camera.project(places)
    seen = camera.sees(xy)
    left = _left(footage, found, places, body.frame)
    points, kept = (len(np.unique(xy[of] // growing.spacing_px, axis=0)) for of in (seen, seen & left))
    if kept >= fitting.min_points or points < fitting.min_points:
        return []
    sources = " and ".join(filter(None, (silhouette_sources(footage), "[[corrections]]" * regions)))
    sentence = f"In frame {body.frame} next to nothing near the clicked joints is left to be measured ({sources})."
    return [doubtful(Cause.CLICKS, sentence, "Correct them, or click the joints again.")]


def _nowhere(footage: Footage, growing: GrowingSettings, monitor: Monitor) -> list[Finding]:
    """A doubt where silhouettes leave less than a point in every frame from which the measurement may begin."""
    first = first_frame(footage)
    frames = [first, *other_frames(footage, first, automatic_seeds=growing.seed_spacing_px > 0)]
    for frame in frames:
        monitor.check()
        found = silhouettes(footage, _rows(footage, frame), frame, first=False)
        if not found or _area_px2(footage, found, frame) >= growing.spacing_px**2:
            return []
    tried = f"{'frame' if len(frames) == 1 else 'frames'} {', '.join(map(str, sorted(frames)))}"
    sentence = f"In {tried} nothing is left to be measured that all these views show as the person: {silhouette_sources(footage)}."
    return [doubtful(Cause.BACKGROUND, sentence, "Correct them, or remove them from take.toml.")]


def _area_px2(footage: Footage, found: tuple[Silhouette, ...], frame: int) -> float:
    """The area of the reference image at some depth of whose rays the person may be."""
    camera, rows = footage.rig.cameras[footage.take.reference], footage.take.rows_at(frame)
    own = next((one.mask for one in found if one.camera is camera), np.ones(rows.rows(np.zeros(camera.size_px[::-1])).shape, dtype=bool))
    y, x = np.nonzero(own)
    chosen = np.unique(np.linspace(0, len(x) - 1, min(PIXELS, len(x))).round().astype(int))
    longest = max(float(np.linalg.norm(other.centre_m - camera.centre_m)) for other in footage.rig.cameras)
    rays = camera.rays(rows.to_frame(np.stack([x[chosen], y[chosen]], axis=1)))
    depths = 1 / np.linspace(1 / (BASES[0] * longest), 1 / (BASES[1] * longest), DEPTHS)
    left = [_left(footage, found, camera.centre_m + rays * depth, frame) for depth in depths] if len(chosen) else []
    return float(np.any(left, axis=0).mean()) * len(x) * rows.step if left else 0.0


def _left(footage: Footage, found: tuple[Silhouette, ...], xyz_m: np.ndarray, frame: int) -> np.ndarray:
    """Which points (N, 3) of a frame a run would keep."""
    outside = Foreground(depth_range_m=(0.0, np.inf), method="", silhouettes=found).excludes(xyz_m, np.zeros((len(xyz_m), 3, 3)))
    return ~(outside | in_regions(xyz_m, frame, footage.take.corrections, footage.rig))


def _about(body: ClickedBody) -> np.ndarray:
    """Places (N, 3) about the bones between clicked joints, and about these joints."""
    located = {name: xyz for name, xyz in body.places_m.items() if np.isfinite(xyz).all()}
    lines = [(located[a], located[b]) for a, b in body.bones if a in located and b in located]
    lines += [(xyz, xyz) for xyz in located.values()]
    random = np.random.default_rng(RANDOM_SEED)
    start, end = np.array(lines)[random.integers(0, len(lines), PLACES)].transpose(1, 0, 2)
    aside = random.normal(size=(PLACES, 3))
    aside *= ABOUT_M * (random.uniform(size=(PLACES, 1)) ** (1 / 3) / np.linalg.norm(aside, axis=1, keepdims=True))
    return np.asarray(start + random.uniform(size=(PLACES, 1)) * (end - start) + aside)


def _rows(footage: Footage, frame: int) -> list[np.ndarray]:
    return [footage.take.rows_at(frame).rows(image) for image in footage.read(frame)]
