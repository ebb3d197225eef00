"""A fitted body as a guide of lost points: they move with their bones, and the body predicts where and when they are visible again.

    X_own = R_bᵀ(t0) (X(t0) − h_b(t0)) ,   X̂(t) = R_b(t) X_own + h_b(t)                         (1)

with the frame R_b, h_b of the bone b whose skin is nearest when the point is lost, at t0. X̂ is visible in the reference camera when the
depth image of the body's skin has nothing in front of it: neither the limb's own front nor another limb.
"""

import numpy as np

from ...body.motion import BodyFit
from ...body.skeleton import bone_frames
from ...body.skin.contour_skin import Skin
from ...body.skin.posed import PosedSkin
from ...foundation import store
from ...geometry.raster import rasterize
from ...take.footage import Footage

ON_SKIN_M = 0.04  # a point further from the skin belongs to no bone
OCCLUDING_M = 0.03  # a surface so much nearer occludes a point: the skin differs from the limb by about a centimetre
WAIT_S = 2.0  # for a lost point: a limb swings there and back


class BodyGuide:
    """The body in every frame of its motion. Skins are made on demand; the last two are cached."""

    def __init__(self, body: BodyFit, footage: Footage) -> None:
        self._skin, self._motion = PosedSkin(body.shape, body.motion.values), body.motion
        self._camera = footage.rig.cameras[footage.take.reference]
        self._R, self._head = bone_frames(body.shape.skeleton, body.shape.lengths_m, body.motion.values)
        self._row = {int(frame): i for i, frame in enumerate(body.motion.frames)}
        self._skins: dict[int, tuple[Skin, np.ndarray]] = {}
        self.longest_frames = round(WAIT_S * footage.take.fps)
        balls = body.shape.metaballs
        parts = (body.motion.frames, body.motion.values, body.shape.lengths_m, balls.centre, balls.radii_m, balls.weight)
        self.key = store.digest("guide 2", *(np.ascontiguousarray(part).tobytes() for part in parts))

    def bind(self, frame: int, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The bone (N,) of each point (N, 3) of a frame, −1 for none, and the point in the bone's axes (N, 3).  (1)"""
        from scipy.spatial import cKDTree

        own, i = np.zeros((len(xyz_m), 3)), self._row.get(frame)
        if i is None or not len(xyz_m):
            return np.full(len(xyz_m), -1, dtype=np.int64), own
        skin, _ = self._visible_skin(frame)
        distance, nearest = cKDTree(skin.vertices_m).query(xyz_m)
        bone = np.where(distance <= ON_SKIN_M, skin.weights[nearest].argmax(axis=1), -1)
        return bone, np.einsum("nji,nj->ni", self._R[i, bone], xyz_m - self._head[i, bone])

    def places(self, frame: int, bone: np.ndarray, own_m: np.ndarray) -> np.ndarray:
        """The predicted places of points (N, 3) of bones (N,) in a frame, NaN in frames without a body.  (1)"""
        i = self._row.get(frame)
        if i is None:
            return np.full((len(bone), 3), np.nan)
        return np.einsum("nij,nj->ni", self._R[i, bone], own_m) + self._head[i, bone]

    def visible(self, frame: int, xyz_m: np.ndarray) -> np.ndarray:
        """Which points (N,) of a frame the body does not occlude in the reference camera."""
        if frame not in self._row:
            return np.zeros(len(xyz_m), dtype=bool)
        _, depth = self._visible_skin(frame)
        xy = self._camera.project(xyz_m)
        inside = self._camera.sees(xy)
        x, y = np.rint(np.where(inside[:, None], xy, 0.0)).astype(np.int64).T
        z = self._camera.to_camera(xyz_m)[:, 2]
        return np.asarray(inside & (z < depth[np.clip(y, 0, len(depth) - 1), np.clip(x, 0, depth.shape[1] - 1)] + OCCLUDING_M))

    def _visible_skin(self, frame: int) -> tuple[Skin, np.ndarray]:
        """The skin in a frame, and its depth image [m] in the reference camera (h, w), inf outside of it."""
        if frame not in self._skins:
            while len(self._skins) > 1:
                del self._skins[next(iter(self._skins))]
            skin = self._skin.at(self._motion.values[self._row[frame]])
            raster = rasterize(self._camera, skin.vertices_m, skin.triangles)
            self._skins[frame] = skin, raster.image(raster.depth_m, np.inf)
        return self._skins[frame]
