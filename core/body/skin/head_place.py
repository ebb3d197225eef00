"""The head of a skin, put where the points of all frames measured it, before the relief.

The anatomical head (ends) has the place and size of the fitted balls, whose face is no better than an ellipsoid's: nose and chin may lie
centimetres beside the person's, the face may look aside, and a relief would then give the chin the shape of a mouth and flatten a cheek. So
it is moved by a similarity (`similarity`, 1). A head on which few points were measured stays where it is.

A bowed or turned head may be fitted in another direction, and its chin taken for the neck. So other places of the face are tried
(OTHERS), and one of them is taken if it agrees clearly better with all points about the head, also those below it: if (1) with ρ of a
fixed width and wider σ_p, a point without a vertex counting as an outlier, is less than CLEARLY of what it is where the fit has the face,
and so is the median misfit of the points that have one (a head pushed down over the neck leaves none without a vertex, and fits nothing).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...geometry.robust import TUKEY
from ...geometry.rotation import rotation_from_vector, vector_from_rotation
from ..shape import BodyShape
from ..skeleton import bone_frames
from .closed_skin import OneSkin
from .ends import HEAD
from .extremities import NECK, has_end
from .facing import Facing
from .relief import Nearby, SurfacePoints
from .similarity import EACH_FOR, FEWEST, Movable, Prior, moved, points_about, registered, residuals
from .surface_operators import vertex_normals

SIZE = 0.1  # what the three ln S have in common
PRIOR = Prior(
    mean=np.array([0.0, 0.0, 0.0, -0.38, 0.0, 0.0, 0.0, 0.0, 0.0]),  # the fitted head is an ellipsoid along the line from chin to crown
    sigma=np.array([0.01, 0.03, 0.015, 0.1, 0.25, 0.1, 0.04, 0.04, 0.04]),  # to the side, up, ahead
    size=SIZE,
)
LEVEL = np.array([0.165, 0.0, 0.0])  # the anatomical head looks up by so much [rad], where a level one is registered to it
JOINT_M = np.array([0.0, 0.020, -0.008])  # where the anatomical head turns on the neck, in the axes of the bone, before it is registered
MOST_TURN = 0.45  # rad, of Q to the side …
MOST_FOUND = 1.2  # … where another place was clearly better
OTHERS = [(up, aside) for up in (-0.1, 0.2, 0.5) for aside in (-0.9, -0.45, 0.0, 0.45, 0.9)]  # rad, of Q: places of the face that are tried
NEAR = np.array([0.02, 0.05, 0.03, 0.15, 0.25, 0.1, 0.04, 0.04, 0.04])  # σ_p about each of them
WIDE = replace(PRIOR, sigma=np.array([0.02, 0.05, 0.03, 0.35, 0.4, 0.15, 0.04, 0.04, 0.04]))  # … by which they are judged
MARGIN_M = 0.1  # about the points: other vertices are none of theirs
BELOW_M = 0.08  # the chin of a bowed head lies so far below the fitted one
CLEARLY = 0.85  # what another place may cost, and misfit, of what the fit's does
JUDGED_M = 0.004  # σ by which they are judged
MOST_TRIED, MOST_JUDGED = 2000, 6000  # points by which they are tried and judged: these stand for all
FEW_STEPS = 8  # while they are tried
REFINED = 3  # of them
OWN = 0.5  # weight of the head in vertices that are compared
NECKS = 0.2  # of the neck's weight with which it goes along


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class HeadPlace:
    """Where the head of a skin was registered."""

    head: Movable
    p: np.ndarray  # (9,) of the similarity
    R: np.ndarray  # (3, 3) axes of its bone in the rest pose
    head_m: np.ndarray  # (3,) where its bone begins there
    length_m: float  # of the bone
    found: bool  # whether it was found where the fit has no face

    def moved(self, skin: OneSkin) -> OneSkin:
        """The skin of the rest pose with its head there."""
        return replace(skin, vertices_m=self.head_m + self.head.at(self.p) @ self.R.T)

    @property
    def facing(self) -> Facing | None:
        """Where the face looks, and where the head begins and ends, in the axes of its bone.

        None if the head would be turned by more than a fit is wrong: then the points do not show the face.
        """
        if abs(self.p[4]) > (MOST_FOUND if self.found else MOST_TURN):
            return None
        joint, crown = moved(np.stack([JOINT_M, [0.0, self.length_m, 0.0]]), self.head.middle, self.p)
        turn = vector_from_rotation(rotation_from_vector(self.p[3:6]) @ rotation_from_vector(LEVEL))
        return Facing(turn=turn, joint_m=joint, crown_m=crown)


def registered_head(skin: OneSkin, shape: BodyShape, frames: Sequence[SurfacePoints]) -> HeadPlace | None:
    """Register the head of a skin in the rest pose to the points of all frames; None without a head, or with too few points."""
    names = [bone.name for bone in shape.skeleton.bones]
    b = names.index(HEAD) if HEAD in names else -1
    if b < 0 or not has_end(shape, b) or not frames:
        return None
    axes, heads = bone_frames(shape.skeleton, shape.lengths_m, np.zeros(len(shape.skeleton.dofs)))
    R, head = axes[b], heads[b]
    own = skin.weights[:, b]
    local = (skin.vertices_m - head) @ R
    points, normals = points_about(shape, b, frames, local[own > OWN])
    if len(points) < FEWEST:
        return None
    necks = skin.weights[:, [name == NECK for name in names]].sum(axis=1)
    weight = own + NECKS * necks
    share = Nearby(skin.vertices_m, skin.faces).mean(weight[:, None])  # wider than the weights, or throat and nape would fold
    across = vertex_normals(skin.vertices_m, skin.faces) @ R
    movable = Movable(x=local, across=across, share=share, own=own > OWN, middle=local[own > OWN].mean(axis=0))
    p = registered(movable, points, normals, PRIOR)
    if p is None:
        return None
    other = _elsewhere(movable, *points_about(shape, b, frames, local[own > OWN], BELOW_M), p)
    place = p if other is None else other
    return HeadPlace(head=movable, p=place, R=R, head_m=head, length_m=float(shape.lengths_m[b]), found=other is not None)


def _elsewhere(skin: Movable, points: np.ndarray, normals: np.ndarray, p: np.ndarray) -> np.ndarray | None:
    """Another place of the head that agrees clearly better with the points about it than p (9,) does; None if there is none."""
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    skin = skin.within(low, high)
    every, some = -(-len(points) // MOST_JUDGED), -(-len(points) // MOST_TRIED)
    few, judged = (points[::some], normals[::some]), (points[::every], normals[::every])

    def misfits(p: np.ndarray) -> np.ndarray:
        return residuals(skin, skin.at(p), p, *judged)[1]

    def cost(p: np.ndarray) -> float:
        """(1), as places are judged."""
        agrees = np.clip(1 - (misfits(p) / (TUKEY * JUDGED_M)) ** 2, 0, None) ** 3
        return float(TUKEY**2 / 3 / EACH_FOR * every * (1 - agrees).sum() + (p - WIDE.mean) @ WIDE.information @ (p - WIDE.mean))

    def misfit_m(p: np.ndarray) -> float:
        """Of the points that belong to a vertex, the median."""
        r = np.abs(misfits(p))
        return float(np.median(r[np.isfinite(r)])) if np.isfinite(r).any() else np.inf

    tried = []
    for up, aside in OTHERS:
        mean = np.array([0.0, 0.0, 0.0, up, aside, 0.0, 0.0, 0.0, 0.0])
        prior = Prior(mean=mean, sigma=NEAR, size=SIZE)
        if (other := registered(skin, *few, prior, stand_for=some, steps=FEW_STEPS)) is not None:
            tried.append(other)
    tried = sorted(tried, key=cost)[:REFINED]
    further = [registered(skin, *judged, WIDE, stand_for=every, start=start) for start in tried]
    places = [*tried, *(place for place in further if place is not None)]
    if not places:
        return None
    best = min(places, key=cost)
    return best if cost(best) < CLEARLY * cost(p) and misfit_m(best) < CLEARLY * misfit_m(p) else None
