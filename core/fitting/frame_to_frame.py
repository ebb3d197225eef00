"""Frame after frame, forwards and backwards from the click frame, with the shape held (D'Apuzzo et al. 1999, §3.3).

Each frame starts from the prediction 2θ_i − θ_{i−1}, which is also a weak observation; tracked points tie it to its neighbour. A frame
that explains far fewer points than its neighbour is tried again from the neighbour's posture; one without points keeps the prediction, and
the next is tried from both.
"""

import numpy as np

from ..progress import Monitor
from .cloud_points import CloudPoints
from .conditions import Conditions
from .material_tracks import MaterialTracks
from .observations import MotionPrior, Observation, StepsFromFixed
from .segmentation import crop
from .solver import Solution, solve
from .state import BodyState

LOST_SUPPORT = 0.6  # a frame with a smaller share of its neighbour's support is tried again
COASTING = 5  # after so many frames without points the prediction stands still
REACH_M = 0.20  # of the points looked at in one frame; half of it is kept for the adjustment of the sequence


def follow(fit: Conditions, points: list[CloudPoints], time_s: np.ndarray, first: Solution, tracks: MaterialTracks | None,
           monitor: Monitor) -> tuple[np.ndarray, list[CloudPoints]]:
    """Motion (T, D) of all frames, and the points near the body in each."""
    T, done = len(points), 1
    motion = np.empty((T, first.motion.shape[1]))
    motion[fit.click] = first.motion[0]
    for direction in (1, -1):
        support, seen = None, [fit.click]
        for t in range(fit.click + direction, T if direction > 0 else -1, direction):
            monitor.step("fit frame after frame", done, T)
            before = fit.parameters.state(motion[t - direction], first.vector)
            moved = _from_neighbour(tracks, t, before, direction) if seen[-1] == t - direction else None
            near = crop(points[t], before, REACH_M)
            motion[t], found = _next_posture(fit, near, moved, _predictions(motion, time_s, seen, t), first, support)
            if found is not None:
                support = found
                seen.append(t)
            done += 1
    return motion, [crop(p, fit.parameters.state(m, first.vector), REACH_M / 2) for p, m in zip(points, motion)]


def _predictions(motion: np.ndarray, time_s: np.ndarray, seen: list[int], t: int) -> list[np.ndarray]:
    last = motion[seen[-1]]
    if len(seen) < 2 or abs(t - seen[-1]) > COASTING:
        return [last]
    rate = (last - motion[seen[-2]]) / (time_s[seen[-1]] - time_s[seen[-2]])
    return [last + rate * (time_s[t] - time_s[seen[-1]]), last]


def _from_neighbour(tracks: MaterialTracks | None, t: int, before: BodyState, direction: int) -> StepsFromFixed | None:
    """What tracked points say about frame t, when the neighbour's body is held."""
    if tracks is None:
        return None
    steps = tracks.steps(t - 1, before, None) if direction > 0 else tracks.steps(t, None, before)
    return None if steps is None else StepsFromFixed(steps=steps, other=before, backwards=direction < 0)


def _next_posture(fit: Conditions, points: CloudPoints, moved: StepsFromFixed | None, predictions: list[np.ndarray], first: Solution,
                  last_support: float | None) -> tuple[np.ndarray, float | None]:
    """The posture (D,) and its support; None if the frame has too few points, and the posture is the prediction."""
    s, skeleton = fit.settings, fit.model.skeleton
    sigma = np.full(len(skeleton.dofs), np.radians(s.prediction_sigma_deg))
    sigma[skeleton.layout.set("base")] = s.prediction_sigma_m
    best, best_support = predictions[0], 0.0
    for start in predictions:
        prior = MotionPrior(mean=start, sigma=sigma)

        def observe(t: int, state: BodyState, prior: MotionPrior = prior) -> list[Observation]:
            return [fit.surface(points, state), *([moved] if moved is not None else []), prior, *fit.priors]

        solution = solve(fit.problem(observe), start[None], first.vector, steps=s.frame_steps, scales=first.scales)
        support = fit.support(points, solution.motion[0], first.vector)
        if support > best_support:
            best, best_support = solution.motion[0], support
        if last_support is None or best_support > LOST_SUPPORT * last_support:
            break
    return (predictions[0], None) if best_support < s.min_points else (best, best_support)
