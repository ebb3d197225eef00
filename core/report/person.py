"""The finished skin of a run (skin/rest.npz, with relief, face, hands and feet) in any pose, for pictures."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..body.motion import BodyFit
from ..body.shape import BodyShape
from ..body.skin.contour_skin import SkinSettings
from ..body.skin.extremities import shape_with_ends
from ..body.skin.fingers import shape_for_skin
from ..body.skin.person_skin import REST, cage, read_skin
from ..body.skin.posed import Poser, skins_in
from ..body.skin.texture import TEXTURE, halves, pixels_of, sampled
from ..foundation.errors import InputError
from ..geometry.raster import Raster
from ..images.picture import decoded


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mesh:
    """A skin in one pose, its vertices weighted by the bones of the fitted body."""

    vertices_m: np.ndarray  # (V, 3)
    triangles: np.ndarray  # (F, 3)
    weights: np.ndarray  # (V, B)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Coloured:
    """The skin of the rest pose with its texture: places (F, 3, 2) of the triangles' corners in 0…1, v upwards."""

    vertices_m: np.ndarray  # (V, 3)
    triangles: np.ndarray  # (F, 3)
    uv: np.ndarray  # (F, 3, 2)
    bgr: np.ndarray  # (S, S, 3) uint8

    def colours(self, raster: Raster) -> np.ndarray:
        """The texture (N, 3) at the samples of a raster of the triangles."""
        weights = raster.pieces.weights(raster.piece, raster.xy_px)
        return sampled(self.bgr, pixels_of(np.einsum("nc,nck->nk", weights, self.uv[raster.triangle]), len(self.bgr)))


SkinAt = Callable[[np.ndarray], Mesh]  # of a pose (D,)


def skin_in(folder: Path, body: BodyFit | None, settings: SkinSettings) -> SkinAt | None:
    """The skin as a function of the pose (D,): that in `folder`, or without one that of the metaballs; None for a body without a skin."""
    if body is None:
        return None
    person = shape_for_skin(body.shape, settings)
    try:
        skin = read_skin(folder / REST, person)
    except InputError:
        return _of_metaballs(body, settings)
    rows, faces = cage(skin)
    triangles = np.stack([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    poser, vertices, weights = Poser(person, skin.weights[rows]), skin.vertices_m[rows], skin.weights[rows] @ _carriers(person, body.shape)
    return lambda pose: Mesh(vertices_m=poser.posed(vertices, pose), triangles=triangles, weights=weights)


def coloured_skin(folder: Path, body: BodyFit, settings: SkinSettings) -> Coloured | None:
    """The run's skin in the rest pose with its texture; None where it has none, or they cannot be read."""
    try:
        skin, picture = read_skin(folder / REST, shape_for_skin(body.shape, settings)), decoded(folder / TEXTURE)
    except InputError:
        return None
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.shape[0] != picture.shape[1]:
        return None  # it was painted over, by something that does not keep its form
    return Coloured(vertices_m=skin.vertices_m, triangles=halves(skin.faces), uv=halves(skin.uv), bgr=picture)


def _of_metaballs(body: BodyFit, settings: SkinSettings) -> SkinAt | None:
    try:
        at = skins_in(shape_with_ends(body.shape, settings), body.motion.values, settings)
    except InputError:
        return None

    def mesh(pose: np.ndarray) -> Mesh:
        skin = at(pose)
        return Mesh(vertices_m=skin.vertices_m, triangles=skin.triangles, weights=skin.weights)

    return mesh


def _carriers(person: BodyShape, body: BodyShape) -> np.ndarray:
    """(B', B): to each bone of the person, fingers and toes too, the bone of the fitted body that it is, or hangs on."""
    names, skeleton = [bone.name for bone in body.skeleton.bones], person.skeleton
    table = np.zeros((len(skeleton.bones), len(names)))
    for b in range(len(skeleton.bones)):
        at = b
        while skeleton.bones[at].name not in names:
            at = skeleton.parents[at]
        table[b, names.index(skeleton.bones[at].name)] = 1.0
    return table
