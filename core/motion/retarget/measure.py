"""Figures of a retargeted motion: agreement of directions, sliding and sinking feet, and the largest rotation between frames."""

from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import angle_of, transposed
from .contacts import Contacts, runs
from .feet import find_legs, lowest
from .mapping import MappedMotion
from .rig import Motion
from .transfer import directions


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Degrees and millimetres."""

    direction_rms_deg: float
    direction_worst_deg: float
    by_part_deg: dict[str, float]
    slide_mm: float
    penetration_mm: float
    float_mm: float
    largest_step_deg: float
    contacts: int
    frames: int

    def __str__(self) -> str:
        feet = (
            f" feet slide up to {self.slide_mm:.1f} mm in {self.contacts} contacts, sink {self.penetration_mm:.1f} mm,"
            if self.contacts
            else ""
        )
        return (
            f"limb directions {self.direction_rms_deg:.2f}° RMS (worst {self.direction_worst_deg:.1f}°),{feet}"
            f" largest turn from frame to frame {self.largest_step_deg:.0f}°"
        )


def measure(source: MappedMotion, target: MappedMotion, contacts: Contacts | None, floor_m: float = 0.0) -> Figures:
    """Compare a target's motion with its source's, frame by frame (both have the same frames)."""
    ours, theirs = directions(target.motion, target.map), directions(source.motion, source.map)
    error = {role: _angle_deg(ours[role], theirs[role]) for role in ours if role in theirs}
    slides, sunk, floating = _feet(target, contacts, floor_m)
    worst = max((float(e.max()) for e in error.values()), default=0.0)
    return Figures(
        direction_rms_deg=_rms(list(error.values())),
        direction_worst_deg=worst,
        by_part_deg={role: _rms([e]) for role, e in error.items()},
        slide_mm=1e3 * max(slides, default=0.0),
        penetration_mm=1e3 * sunk,
        float_mm=1e3 * floating,
        largest_step_deg=_largest_step_deg(target.motion),
        contacts=len(slides),
        frames=len(target.motion.frames),
    )


def _angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def _rms(errors: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) if errors else 0.0


def _largest_step_deg(motion: Motion) -> float:
    if len(motion.frames) < 2:
        return 0.0
    return float(np.degrees(angle_of(transposed(motion.R[:-1]) @ motion.R[1:]).max()))


def _feet(target: MappedMotion, contacts: Contacts | None, floor_m: float) -> tuple[list[float], float, float]:
    """The slide [m] of each joint in contact from its first position; the sole's greatest depth in the floor, and its greatest height over
    the floor in contacts."""
    slides, sunk, floating = [], 0.0, 0.0
    motion = target.motion
    for side, leg in find_legs(motion.rig, target.map, floor_m).items():
        foot = leg.foot[0]
        ankle = motion.head_m[:, foot]
        ball = ankle + motion.R[:, foot] @ (leg.rig.R_rest[foot].T @ (leg.ball_m - leg.rig.head_m[foot]))
        height = ankle[:, 2] + lowest(leg, motion.R) - floor_m
        sunk = max(sunk, float(-height.min()))
        if contacts is None or side not in contacts.sides:
            continue
        for joint, on in ((ankle, contacts.ankle[side] & ~_rolling(contacts, side)), (ball, contacts.toe[side])):
            slides += [float(np.linalg.norm(joint[a:b, :2] - joint[a, :2], axis=1).max()) for a, b in runs(on)]
        standing = contacts.ankle[side] | contacts.toe[side]
        floating = max(floating, float(height[standing].max(initial=0.0)))
    return slides, sunk, floating


def _rolling(contacts: Contacts, side: str) -> np.ndarray:
    """Frames in which the ankle moves about the standing ball of the foot: not a contact of its own."""
    return contacts.toe[side] & ~contacts.ankle[side]
