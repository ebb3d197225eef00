"""Who is filmed: a body that moves in a known way, as meshes, and where the cameras stand for it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..body.shape import BodyShape
from .figure import Part


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Subject:
    """One person or limb. `shape` has its bones; its metaballs are the truth only where `is_metaballs`."""

    shape: BodyShape
    joints: tuple[str, ...]  # that are clicked and known
    motion: Callable[[np.ndarray | float], np.ndarray]  # (…) seconds -> (…, D) values of the degrees of freedom
    parts: Callable[[float], tuple[Part, ...]]  # the meshes at one moment
    backdrop: Part
    target_m: np.ndarray  # (3,) where the cameras look
    scale: float  # distances of the cameras by those for an arm
    is_metaballs: bool
