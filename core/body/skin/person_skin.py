"""The skin of a person: made in the rest pose, faired, with the measured relief, and posed in every frame; its file skin/rest.npz.

    metaballs ── one closed mesh (closed_skin) ── without rings and ledges (fairing, edges) ── what all frames measured (relief)
      ──▶ OneSkin in the rest pose ── posing ──▶ skin/NNNN.ply;  scene and exports bind it to their armature

The mesh of a whole body has DETAIL² quads for each quad of its cage; the skins of the frames have the quads of the cage.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...foundation import store
from ...foundation.errors import InputError
from ...foundation.progress import Monitor
from ..shape import BodyShape
from .closed_skin import OneSkin, one_skin, unflipped
from .contour_skin import MOST_BONES
from .edges import eased, faired_outside_folds, without_folds, without_slits
from .ends import HEAD
from .fairing import OF_RELIEF, anatomical, faired
from .fingers import FINGER_BONE, RIGID_BONE
from .head_place import HeadPlace
from .mesh import DETAIL, SkinSettings, chain_faces, chains_uv
from .rays import smooth
from .relief import SurfacePoints, measured_relief
from .welding import cut

REST = "rest.npz"  # in the folder skin/
VERSION = 1
MOST_PIECES = 64
NAPE, JAW = 0.3, 0.95  # weights of the head in vertices where it begins, and where nearly all is the head's
DIGIT = 0.05  # … of fingers or toes, hands or feet in vertices that are theirs
HAND_OR_FOOT = re.compile(rf"(hand|foot)\.[RL]|{FINGER_BONE.pattern}")
END_M = 0.06  # within this distance of its ends a limb keeps its shape


def rest_skin(shape: BodyShape, settings: SkinSettings) -> OneSkin:
    """The skin of the rest pose before relief. 5 s for a whole body.

    Raises:
        InputError: there are no metaballs, or the number of rays is odd.
    """
    skin = one_skin(shape, settings, DETAIL)
    if not settings.fair:
        return skin
    fair = faired(skin.vertices_m, skin.faces, _kept(skin, shape))
    return replace(skin, vertices_m=eased(fair, skin.faces, _plain(skin, shape)))


def _plain(skin: OneSkin, shape: BodyShape) -> np.ndarray:
    """(V,) bool: the vertices that belong neither to the head nor to fingers or toes, whose shapes have edges."""
    head, digits = _share(skin, shape, re.compile(HEAD)), _share(skin, shape, FINGER_BONE)
    return np.asarray((head < NAPE) & (digits < DIGIT))


def _may_slit(skin: OneSkin, shape: BodyShape) -> np.ndarray:
    """(V,) bool: the vertices where the relief may open slits: not those of face, hands and feet, whose hollows are their own."""
    head, ends = _share(skin, shape, re.compile(HEAD)), _share(skin, shape, HAND_OR_FOOT)
    return np.asarray((head < JAW) & (ends < DIGIT))


def _share(skin: OneSkin, shape: BodyShape, bones: re.Pattern[str]) -> np.ndarray:
    """(V,) the weights of the bones of these names."""
    return np.asarray(skin.weights[:, [bones.fullmatch(bone.name) is not None for bone in shape.skeleton.bones]].sum(axis=1))


def _kept(skin: OneSkin, shape: BodyShape) -> np.ndarray:
    """(V,) 0 to 1: to what degree vertices keep their places when the skin is faired."""
    kept = anatomical(shape, skin.weights)
    if skin.rays:  # a limb alone: its ends are no part of a surface that goes on
        from_end = np.min([np.linalg.norm(skin.vertices_m - skin.vertices_m[pole], axis=1) for pole in (0, -1)], axis=0)
        kept = np.maximum(kept, 1 - smooth(from_end / END_M - 1))
    return kept


def with_relief(
    skin: OneSkin, shape: BodyShape, frames: list[SurfacePoints], place: HeadPlace | None, mirror: bool, monitor: Monitor
) -> OneSkin:
    """The skin displaced by what the points of all frames show, with its head in its `place`, without flipped quads.

    Raises:
        Cancelled: the monitor was cancelled.
    """
    straight, skin = skin, skin if place is None else place.moved(skin)
    relief = measured_relief(skin, shape, frames, mirror, monitor, straight)
    along = relief.along
    displacement = without_folds(skin.vertices_m, skin.faces, relief.displacement_m, along)
    rough, every = skin.vertices_m + displacement[:, None] * along, np.ones(len(along), dtype=bool)
    fair = faired_outside_folds(rough, skin.faces, faired(rough, skin.faces, _kept(skin, shape), OF_RELIEF))
    moved = eased(unflipped(fair, skin.faces, every), skin.faces, _plain(skin, shape), straight.vertices_m)
    moved = without_slits(straight.vertices_m, moved, skin.faces, _may_slit(skin, shape))
    moved = unflipped(moved, skin.faces, every)
    displacement = np.einsum("vk,vk->v", moved - skin.vertices_m, along)
    return replace(skin, vertices_m=moved, relief_m=displacement, sigma_m=relief.sigma_m)


def cage(skin: OneSkin) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of a skin at the corners of its cage's quads, as indices (V',), and these quads (F', 4) of them."""
    if skin.rays:
        return _cage_of_chain(len(skin.vertices_m), skin.rays, skin.pieces)
    used, faces = np.unique(_corners(skin.faces, skin.pieces), return_inverse=True)
    return used, faces.reshape(-1, 4)


def _cage_of_chain(count: int, rays: int, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """The cage of a mesh of `count` vertices on contours of `rays`, between poles."""
    contours = np.arange(pieces - 1, (count - 2) // rays, pieces)
    rows = np.concatenate([[0], (1 + contours[:, None] * rays + np.arange(0, rays, pieces)).ravel(), [count - 1]])
    return rows, chain_faces(len(rows), rays // pieces)


def _corners(values: np.ndarray, pieces: int) -> np.ndarray:
    """The values (F', 4, …) at the corners of the cage's quads, of those (F, 4, …) of the quads that they are cut into."""
    grid = values.reshape(-1, pieces, pieces, *values.shape[1:])
    return np.stack([grid[:, 0, 0, 0], grid[:, 0, -1, 1], grid[:, -1, -1, 2], grid[:, -1, 0, 3]], axis=1)


def resampled(skin: OneSkin, detail: int) -> OneSkin:
    """The skin with `detail` pieces for each edge of its cage."""
    skin = skin if detail % skin.pieces == 0 else _only_cage(skin)
    if detail == skin.pieces:
        return skin
    measured = [value[:, None] for value in (skin.relief_m, skin.sigma_m) if value is not None]
    values, bones, times = np.concatenate([skin.weights, *measured], axis=1), skin.weights.shape[1], detail // skin.pieces
    vertices, values, part, faces, uv = cut(skin.vertices_m, values, skin.part, skin.faces, skin.uv, times)
    return replace(
        skin,
        vertices_m=vertices,
        faces=faces,
        uv=uv,
        weights=values[:, :bones] / values[:, :bones].sum(axis=1, keepdims=True),
        part=part,
        pieces=detail,
        rays=0,
        relief_m=values[:, bones] if measured else None,
        sigma_m=values[:, bones + 1] if measured else None,
    )


def _only_cage(skin: OneSkin) -> OneSkin:
    rows, faces = cage(skin)
    rays = skin.rays // skin.pieces
    return replace(
        skin,
        vertices_m=skin.vertices_m[rows],
        faces=faces,
        uv=chains_uv((len(rows),), rays, faces) if rays else _corners(skin.uv, skin.pieces),
        weights=skin.weights[rows],
        part=skin.part[rows],
        pieces=1,
        rays=rays,
        relief_m=None if skin.relief_m is None else skin.relief_m[rows],
        sigma_m=None if skin.sigma_m is None else skin.sigma_m[rows],
    )


def write_skin(path: Path, skin: OneSkin) -> None:
    """Write skin/rest.npz.

    Raises:
        InputError: the file cannot be written.
    """
    bones = np.argsort(-skin.weights, axis=1, kind="stable")[:, :MOST_BONES]
    arrays: dict[str, np.ndarray] = dict(
        vertices_m=skin.vertices_m.astype(np.float32),
        faces=skin.faces.astype(np.int32),
        uv=skin.uv.astype(np.float32),
        part=skin.part.astype(np.uint8),
        bones=bones.astype(np.uint16),
        weights=np.take_along_axis(skin.weights, bones, axis=1).astype(np.float32),
    )
    if skin.relief_m is not None and skin.sigma_m is not None:
        arrays |= dict(relief_m=skin.relief_m.astype(np.float32), sigma_m=skin.sigma_m.astype(np.float32))
    store.save(path, arrays, {"skin_version": VERSION, "bone_names": list(skin.bone_names), "pieces": skin.pieces, "rays": skin.rays})


def read_skin(path: Path, shape: BodyShape) -> OneSkin:
    """Read skin/rest.npz of a body.

    Raises:
        InputError: it is missing or damaged, or its bones are not those of the body.
    """
    arrays, header = store.load(path)
    layout = dict(vertices_m=("f", "V3"), faces=("iu", "F4"), uv=("f", "F42"), part=("iu", "V"), bones=("iu", "VK"), weights=("f", "VK"))
    measured = [name for name in ("relief_m", "sigma_m") if name in arrays]
    store.check_layout(path, arrays, **layout, **{name: ("f", "V") for name in measured})
    names, count = header.get("bone_names"), len(arrays["vertices_m"])
    bone_names = [bone.name for bone in shape.skeleton.bones]
    there = [name for name in bone_names if isinstance(names, list) and name in names]
    if names != there or not all(RIGID_BONE.fullmatch(name) for name in {*bone_names} - {*there}):  # files without fingers or toes
        raise InputError(f"{path} has other bones than body.toml; run the fit again.")
    faces, bones, weights = arrays["faces"].astype(np.int64), arrays["bones"].astype(np.int64), arrays["weights"].astype(np.float64)
    pieces, rays = (n if isinstance(n := header.get(name), int) and n >= 0 else -1 for name in ("pieces", "rays"))
    inside = (
        _is_mesh(count, len(faces), pieces, rays)
        and faces.min() >= 0
        and faces.max() < count
        and bones.min() >= 0
        and bones.max() < len(names)
    )
    finite = all(np.isfinite(a).all() for a in (arrays["vertices_m"], arrays["uv"], weights, *(arrays[name] for name in measured)))
    if not (inside and finite and (weights >= 0).all() and (weights.sum(axis=1) > 0).all()):
        raise InputError(f"{path} is damaged: its faces, weights or positions cannot be; run the fit again.")
    table = np.zeros((count, len(bone_names)))
    bones = np.array([bone_names.index(name) for name in names])[bones]
    np.put_along_axis(table, bones, weights / weights.sum(axis=1, keepdims=True), axis=1)
    return OneSkin(
        vertices_m=arrays["vertices_m"],
        faces=faces,
        uv=arrays["uv"],
        weights=table,
        part=arrays["part"],
        bone_names=tuple(bone_names),
        pieces=pieces,
        rays=rays,
        relief_m=arrays.get("relief_m"),
        sigma_m=arrays.get("sigma_m"),
    )


def _is_mesh(vertices: int, faces: int, pieces: int, rays: int) -> bool:
    """Whether a skin can have so many vertices and faces."""
    if not 0 < pieces <= MOST_PIECES or faces < 1:
        return False
    if rays == 0:
        return faces % pieces**2 == 0
    contours = (vertices - 2) // rays if rays > 0 else 0
    return contours > 0 and rays % (2 * pieces) == 0 and vertices == contours * rays + 2 and (contours + 1) % pieces == 0
