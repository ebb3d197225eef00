"""The complete model: metaballs in an anatomical arrangement, made from the simplified body (D'Apuzzo et al. 1999, §3.1, §4).

Every bone gets a core along its axis, and around it balls for the groups of muscle and fat that shape it (`anatomy`), placed and sized by
the bone's profile. Then all cross radii are adjusted together until the surface is the simplified body's:

    √(−½ ln F_complete(X)) = √(−½ ln F_simplified(X)) at points X of the surface and a little outside it,   ln l = its start ± 50 %    (1)

So the refined fit begins with the same body and departs from it only where the data require it. A bone without a table (in a user's own
model) gets rings of four balls. The whole body has 150 balls.
"""

from dataclasses import replace

import numpy as np

from .anatomy import Ball, arrangement
from .metaballs import STATIONS, VISIBLE, Metaballs, field
from .parts import BoneProfile, bone_profiles, chain_neighbours
from .shape import BodyShape, FieldSamples, root_of, with_radii_for
from .skeleton import bone_frames

ALONG = 9  # points of the simplified surface along a bone …
AROUND = 12  # … and around it
OUTSIDE = 1.25  # distance from the axis of the points outside, in radii
OUTSIDE_WEIGHT = 0.2  # of the points outside
LEAST_F = 1e-4  # of the field at the points, for its logarithm
FREE = 0.2  # sigma of ln l in (1): muscles keep their part of the surface
SEGMENT = 2 / 3  # span of the three balls of a limb, from 1/6 to 5/6 of the bone
ROUND = 0.9  # on stout bones, where the tables' balls would be flat: l along the bone over l across it, at least


def complete_shape(shape: BodyShape) -> BodyShape:
    """The same body of balls in an anatomical arrangement. Cost: about 2 s for a whole body."""
    lengths, simple = shape.lengths_m, shape.metaballs
    counted = chain_neighbours(shape)
    profiles = bone_profiles(shape.skeleton, lengths, simple, counted)
    start = _placed(shape, profiles)
    R, head = bone_frames(shape.skeleton, lengths, np.zeros(len(shape.skeleton.dofs)))
    places = {b: _about(profile, R[b], head[b], float(lengths[b])) for b, profile in profiles.items()}
    X, bone = np.concatenate(list(places.values())), np.repeat(list(places), 2 * ALONG * AROUND)
    F = np.maximum(field(simple, lengths, R, head, X, counted[bone][:, simple.bone_index]), LEAST_F)
    weight = np.tile(np.repeat([1.0, OUTSIDE_WEIGHT], ALONG * AROUND), len(places))
    samples = FieldSamples(xyz_m=X, active=counted[bone][:, start.bone_index], root=root_of(F), weight=weight)
    balls = with_radii_for(start, np.arange(len(start.weight)), lengths, R, head, samples, FREE)
    return replace(shape, metaballs=balls, radius_sigma_m=np.full(balls.radii_m.shape, np.nan), weight_sigma=None)


def _placed(shape: BodyShape, profiles: dict[int, BoneProfile]) -> Metaballs:
    """The balls placed by the profile; their sizes are fractions of its radii there."""
    bone_index, centre, radii = [], [], []
    for b, profile in profiles.items():
        name, length = shape.skeleton.bones[b].name, float(shape.lengths_m[b])
        side = -1.0 if name.endswith(".L") else 1.0  # a left bone's x axis is the right one's mirror image
        for ball in arrangement(name):
            along = _on_bone(profile, ball)
            ahead, behind = profile.across(np.full(2, along), np.array([[1.0, 1.0], [-1.0, -1.0]]))
            half = (ahead + behind) / 2
            at = (ahead - behind) / 2 + np.array([side * ball.aside, ball.ahead]) * half  # a calf lies off its bone
            bone_index.append(b)
            centre.append([at[0] / length, along, at[1] / length])
            cross = ball.width / VISIBLE * half
            radii.append([cross[0], max(ball.length * _span(profile) * length, ROUND * cross.mean()), cross[1]])
    return Metaballs(bone_index=np.array(bone_index), centre=np.array(centre), radii_m=np.array(radii), weight=np.ones(len(bone_index)))


def _span(profile: BoneProfile) -> float:
    """The span of a bone's balls by that of a limb's three balls."""
    return float(profile.stations[-1] - profile.stations[0]) / SEGMENT


def _on_bone(profile: BoneProfile, ball: Ball) -> float:
    """The ball's fraction along this bone; its table is that of a limb with balls from 1/6 to 5/6."""
    return float(profile.stations[0] + (ball.along - STATIONS[0]) * _span(profile))


def _about(profile: BoneProfile, R: np.ndarray, head: np.ndarray, length: float) -> np.ndarray:
    """Points (2 · ALONG · AROUND, 3) on the profile and outside it."""
    along = np.repeat(np.linspace(profile.stations[0], profile.stations[-1], ALONG), AROUND)
    angle = np.tile(2 * np.pi * np.arange(AROUND) / AROUND, ALONG)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = profile.across(along, direction) * direction
    rows = [np.stack([far * across[:, 0], along * length, far * across[:, 1]], axis=1) for far in (1.0, OUTSIDE)]
    return np.asarray(head + np.concatenate(rows) @ R.T)
