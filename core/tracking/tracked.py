"""The tracked points of one frame."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from .settings import TrackStatus

ROWS = ("identity", "xy", "shape", "xyz_m", "covariance_m2", "key_shape", "key_drift", "drift", "local_surface", "key_local_surface")


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class TrackedFrame:
    """N points of one frame, by ascending identity. Rows' pixels, metres.

    A point has a key template (templates.py), its patch in an earlier frame: `key_drift` is the covariance of that template's place on the
    body, `drift` that of the point against the template; their sum is the covariance of the point's drift since its first frame.
    `local_surface` has the slopes and the sag of the surface under the point (curvature_correction.py), `key_local_surface` those where its
    key template was cut.
    """

    frame: int
    identity: np.ndarray  # (N,) int, ascending
    xy: np.ndarray  # (N, K, 2)
    shape: np.ndarray  # (N, K, 2, 2) from the reference view to each view
    xyz_m: np.ndarray  # (N, 3)
    covariance_m2: np.ndarray  # (N, 3, 3)
    key_shape: np.ndarray  # (N, 2, 2) from the key template to the reference view
    key_drift: np.ndarray  # (N, 2, 2) px²
    drift: np.ndarray  # (N, 2, 2) px²
    local_surface: np.ndarray  # (N, 3)
    key_local_surface: np.ndarray  # (N, 3)
    ended: np.ndarray  # (M,) identities of the points that were lost in this frame
    reason: np.ndarray  # (M,) TrackStatus

    @property
    def renewed(self) -> np.ndarray:
        """(N,) the points whose key template is their patch in this frame."""
        return np.asarray((self.key_shape == np.eye(2)).all(axis=(1, 2)))

    def select(self, rows: np.ndarray) -> "TrackedFrame":
        """Only these rows (a mask or indices), with all that ended."""
        values: dict[str, Any] = {n: getattr(self, n)[rows] for n in ROWS}
        return replace(self, **values)

    def without(self, gone: np.ndarray, why: np.ndarray | TrackStatus) -> "TrackedFrame":
        """The frame after the points of some rows (a mask) ended, for one reason or one each (N,)."""
        reason = np.broadcast_to(np.asarray(why, dtype=np.int8), gone.shape)[gone]
        left = self.select(~gone)
        return replace(
            left, ended=np.concatenate([self.ended, self.identity[gone]]), reason=np.concatenate([self.reason, reason]).astype(np.int8)
        )

    def changed(self, rows: np.ndarray, other: "TrackedFrame") -> "TrackedFrame":
        """The frame with the rows `rows` replaced by all rows of another frame, except for their identities."""
        values: dict[str, Any] = {n: getattr(self, n).copy() for n in ROWS if n != "identity"}
        for name, array in values.items():
            array[rows] = getattr(other, name)
        return replace(self, **values)

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by name, for a checkpoint."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "frame"}


def joined(first: TrackedFrame, second: TrackedFrame) -> TrackedFrame:
    """The points of both, which are of one frame, by ascending identity; what ended in the first stays ended unless the second has it."""
    order = np.argsort(np.concatenate([first.identity, second.identity]), kind="stable")
    both: dict[str, Any] = {n: np.concatenate([getattr(first, n), getattr(second, n)])[order] for n in ROWS}
    still = ~np.isin(first.ended, second.identity)
    return replace(first, ended=first.ended[still], reason=first.reason[still], **both)


def born(frame: int, identity: np.ndarray, xy: np.ndarray, shape: np.ndarray, xyz_m: np.ndarray, covariance_m2: np.ndarray) -> TrackedFrame:
    """New points: their key template is their patch in this frame."""
    n = len(identity)
    none = np.zeros((n, 2, 2))
    return TrackedFrame(
        frame=frame,
        identity=identity,
        xy=xy,
        shape=shape,
        xyz_m=xyz_m,
        covariance_m2=covariance_m2,
        key_shape=np.tile(np.eye(2), (n, 1, 1)),
        key_drift=none,
        drift=none,
        local_surface=np.zeros((n, 3)),
        key_local_surface=np.zeros((n, 3)),
        ended=np.zeros(0, dtype=np.int64),
        reason=np.zeros(0, dtype=np.int8),
    )


def nothing(frame: int, views: int) -> TrackedFrame:
    """A frame without points."""
    z = np.zeros
    return born(frame, z(0, np.int64), z((0, views, 2)), z((0, views, 2, 2)), z((0, 3)), z((0, 3, 3)))


def rows_of(identity: np.ndarray, wanted: Sequence[int] | np.ndarray) -> np.ndarray:
    """The rows of the wanted identities among ascending ones, −1 where there is none."""
    wanted = np.asarray(wanted, dtype=np.int64)
    if not len(identity):
        return np.full(len(wanted), -1, dtype=np.int64)
    at = np.searchsorted(identity, wanted).clip(0, len(identity) - 1)
    return np.where(identity[at] == wanted, at, -1)
