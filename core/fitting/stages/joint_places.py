"""The places of the joints in the body: where they usually lie, and as they were clicked.

Where in the flesh a joint lies, a surface does not show, and a click elsewhere in one frame cannot outweigh the points of all frames. But a
joint has the same place in its bone in all of them. After the adjustment each joint gets a shift d in the axes of the bone that ends there,
from where it usually lies (m, of the body model), the clicks of any frame, and its motion, for bones turn about their joints:

    click_k = projection_k(X + R d + e) + ε ,   ε ~ N(0, σ) ,   e ~ N(0, POSE_SIGMA_M) common to the views of one frame           (1)
    d = m + c + o ,   c ~ N(0, COMMON r) the same on the left and on the right (mirrored) ,   o ~ N(0, OWN r)                         (2)
    X(θ_t + p_t, L) − X(θ_t) − R d ~ N(0, MOTION_SIGMA_M) ,   p_t ~ N(0, TURN_SIGMA)                                              (3)

r is the thickness of the flesh at the joint; m is 0 of joints with keypoints. The priors of L are those of the fit, about lengths that
follow the usual places. σ is estimated from how well the rays of the clicks meet, with the knob `click_sigma_px` as `PRIOR_FREEDOM` further
observations. Unknown are d, the bone lengths L with their priors, and p_t, which are eliminated frame by frame. In (3) the frames within
`CORRELATION_S` count as one. The metaballs stay where they are: their centres in the bones' axes change. A joint whose clicks are further
away than (1) and (2) explain is in a wrong pose, and not in another place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...body.model_file import joint_depths_m
from ...body.skeleton import bone_frames
from ..context import FitContext
from ..solve.solver import Solution
from ..state import BodyState, ShapeParameters
from .inverse_kinematics import CORRELATION_S

POSE_SIGMA_M = 0.008
COMMON, OWN = 0.35, 0.2
NO_FLESH_M = 0.06  # r of a joint without flesh
PRIOR_FREEDOM = 6.0
FURTHEST = 3.0  # sigmas of (1) and (2) together
MIRRORED = np.diag([-1.0, 1.0, 1.0])  # a bone's axes on the other side
MOTION_SIGMA_M = 0.004
TURN_SIGMA, BASE_SIGMA_M = float(np.radians(8.0)), 0.05
STEPS = 6  # of Gauss-Newton
FRAMES = 60  # evenly over the recording, that determine the places
SINGULAR = 1e-9  # of singular values: one view shows no depth


@dataclass(frozen=True, eq=False, kw_only=True)
class JointPlaces:
    """Other places of the joints in a body: its shape vector (S,), the shifts (J, 3) [m] with the sigmas (J,) of a coordinate, and the
    centres (M, 3) of its metaballs."""

    vector: np.ndarray
    shift: np.ndarray
    sigma_m: np.ndarray
    centre: np.ndarray

    def applied(self, fit: FitContext, solution: Solution) -> tuple[FitContext, Solution]:
        """The context and the solution of the body with these places, whose surface lies where it lay."""
        parameters, before = fit.parameters, fit.parameters.states(solution.motion, solution.vector)
        motion = solution.motion
        for _ in range(STEPS):
            states = parameters.states(motion, self.vector)
            motion = motion + np.stack([_Frame.of(old, new, self.shift).turned() for old, new in zip(before, states)])
        return self.placed(fit), replace(solution, motion=motion, vector=self.vector)

    def placed(self, fit: FitContext) -> FitContext:
        """The context of the body with these places."""
        template = fit.parameters.template
        template = replace(template, metaballs=replace(template.metaballs, centre=self.centre))
        return replace(fit, parameters=ShapeParameters(template, fit.settings.weights))


def has_both_sides(joint_names: Sequence[str]) -> bool:
    """Whether some joint is on the left and on the right: one side alone does not tell where joints lie from how they were clicked."""
    return any(name.endswith(".L") and f"{name.removesuffix('.L')}.R" in joint_names for name in joint_names)


def joints_in_place(fit: FitContext, motion: np.ndarray, vector: np.ndarray, time_s: np.ndarray) -> JointPlaces | None:
    """The places of the joints, for a body with a motion (T, D) at `time_s` (T,) and a vector (S,); None where nothing tells them: without
    clicks and without usual places."""
    seen = _seen(fit, motion, vector)
    if not seen and not _usual_m(fit).any():
        return None
    some = np.unique(np.linspace(0, len(motion) - 1, min(FRAMES, len(motion))).round().astype(int))
    share = min(1.0, float(np.median(np.diff(time_s[some]))) / CORRELATION_S) if len(some) > 1 else 1.0
    before, motion, vector = fit.parameters.states(motion[some], vector), motion[some], vector.copy()
    lengths, shift = fit.parameters.layout.group("lengths"), np.zeros((len(fit.parameters.skeleton.joint_names), 3))
    of_shifts, longer = _of_shifts(fit, seen), _longer_by_usual_places(fit)
    for _ in range(STEPS):
        states = fit.parameters.states(motion, vector)
        believed = vector.copy()
        believed[lengths] -= longer
        A, g = _of_shape(fit, fit.parameters.state(motion[0], believed), shift, of_shifts, share * len(some))
        frames = [_Frame.of(old, new, shift) for old, new in zip(before, states)]
        for frame in frames:
            A += share * frame.reduced[0]
            g += share * frame.reduced[1]
        step = np.linalg.solve(A, g)
        motion = motion + np.stack([frame.turned(step) for frame in frames])
        vector[lengths] += step[: len(lengths)]
        shift += step[len(lengths) :].reshape(-1, 3)
    variance = np.diag(np.linalg.inv(A))[len(lengths) :].reshape(-1, 3)
    centre = _centres_in_place(fit.parameters, before, motion, vector)
    return JointPlaces(vector=vector, shift=shift, sigma_m=np.sqrt(variance.mean(axis=1)), centre=centre)


def place_sigmas(fit: FitContext) -> np.ndarray:
    """Sigma (J,) [m] of where a joint lies in its bone, without clicks.  (2)"""
    return float(np.hypot(COMMON, OWN)) * _thickness(fit)


def _thickness(fit: FitContext) -> np.ndarray:
    """r (J,) [m]."""
    radius = joint_depths_m(fit.model)
    return np.array([radius.get(name, NO_FLESH_M) for name in fit.parameters.skeleton.joint_names])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Frame:
    """The equations (3) of one frame: turns p (D,) by p = p₀ − P s, and normal equations of s, lengths and shifts (B + 3J), without p."""

    p: np.ndarray  # (D,)
    P: np.ndarray  # (D, B + 3J)
    reduced: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(old: BodyState, new: BodyState, shift: np.ndarray) -> "_Frame":
        """Those of the body before and the present one, at the present shifts (J, 3)."""
        skeleton, D = old.skeleton, old.layout.n_pose
        R = old.R[[bone for bone, _ in skeleton.joint_bones]]
        X, dX = new.joint_jacobian
        r = (old.joints_m + np.einsum("jab,jb->ja", R, shift) - X).ravel() / MOTION_SIGMA_M
        J = dX[:, :, : D + len(old.lengths_m)].reshape(len(r), -1) / MOTION_SIGMA_M
        joints, by_shift = np.arange(len(R)), np.zeros((len(R), 3, len(R), 3))
        by_shift[joints, :, joints] = -R / MOTION_SIGMA_M
        S = np.concatenate([J[:, D:], by_shift.reshape(len(r), -1)], axis=1)
        sigma = np.full(D, TURN_SIGMA)
        sigma[skeleton.layout.group("base")] = BASE_SIGMA_M
        pose = J[:, :D]
        pose[:, skeleton.locked] = 0.0
        mixed = pose.T @ S
        A, g = pose.T @ pose + np.diag(sigma**-2), pose.T @ r - (new.motion - old.motion) / sigma**2
        solved = np.linalg.solve(A, np.column_stack([g, mixed]))
        reduced = S.T @ S - mixed.T @ solved[:, 1:], S.T @ r - mixed.T @ solved[:, 0]
        return _Frame(p=solved[:, 0], P=solved[:, 1:], reduced=reduced)

    def turned(self, step: np.ndarray | None = None) -> np.ndarray:
        """The step of the pose (D,), with one of lengths and shifts (B + 3J,) or without."""
        return self.p if step is None else self.p - self.P @ step


def _of_shape(
    fit: FitContext, state: BodyState, shift: np.ndarray, of_shifts: tuple[np.ndarray, np.ndarray], frames: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of lengths and shifts (B + 3J): the priors of the shape, which count for so many frames, (1) and (2)."""
    B, (K, k), columns = len(state.lengths_m), of_shifts, fit.parameters.layout.columns("lengths")
    A, g = np.zeros((B + len(k), B + len(k))), np.zeros(B + len(k))
    for prior in fit.shape_observations():
        W = prior.jacobian(state)[:, columns]
        A[:B, :B] += frames / fit.frames * W.T @ W
        g[:B] -= frames / fit.frames * W.T @ prior.residual(state)
    A[B:, B:], g[B:] = K, k - K @ shift.ravel()
    return A, g


@dataclass(frozen=True, eq=False, kw_only=True)
class _Seen:
    """What the clicks of one joint in one frame show: information M (3, 3) about its distance u from the fitted one, and M u (3,)."""

    joint: int
    R: np.ndarray  # (3, 3) of its bone
    M: np.ndarray
    Mu: np.ndarray

    def likely(self, usual: np.ndarray, prior: np.ndarray) -> bool:
        """Whether u is within (1) and (2), vᵀ (M⁻¹ + K)⁻¹ v of v = u − R m small enough for the prior m (3,), K (3, 3) of the shift."""
        Mv = self.Mu - self.M @ self.R @ usual
        v = np.linalg.lstsq(self.M, Mv, rcond=SINGULAR)[0]
        return float(v @ np.linalg.solve(np.eye(3) + self.M @ prior, Mv)) < 3 * FURTHEST**2


def _seen(fit: FitContext, motion: np.ndarray, vector: np.ndarray) -> list[_Seen]:
    """Every clicked joint in every frame, with the sigma of a click by all of them.  (1)"""
    bones, found = fit.parameters.skeleton.joint_bones, []
    squares, freedom = PRIOR_FREEDOM * fit.settings.click_sigma_px**2, PRIOR_FREEDOM
    for t, clicks in sorted(fit.clicked.items()):
        state = fit.parameters.state(motion[t], vector)
        for joint in np.unique(clicks.joint).tolist():
            rows = np.flatnonzero(clicks.joint == joint).tolist()
            projected = [clicks.cameras[k].project_with_jacobian(state.joints_m[joint]) for k in rows]
            r = np.concatenate([clicks.xy_px[k] - xy for k, (xy, _) in zip(rows, projected)])
            J = np.concatenate([by_place for _, by_place in projected])
            if len(rows) > 1:
                squares += float(np.sum((r - J @ np.linalg.lstsq(J, r, rcond=SINGULAR)[0]) ** 2))
                freedom += len(r) - 3
            found.append(_Seen(joint=joint, R=state.R[bones[joint][0]], M=J.T @ J, Mu=J.T @ r))
    variance = squares / freedom
    shrunk = [np.linalg.inv(variance * np.eye(3) + POSE_SIGMA_M**2 * s.M) for s in found]
    return [replace(s, M=share @ s.M, Mu=share @ s.Mu) for s, share in zip(found, shrunk)]


def _of_shifts(fit: FitContext, seen: Sequence[_Seen]) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix (3J, 3J) and right side (3J,) of the shifts by (1) and (2)."""
    names, r = fit.parameters.skeleton.joint_names, _thickness(fit)
    sides = np.array([name.removesuffix(".R").removesuffix(".L") for name in names])
    pair = (sides[:, None] == sides) & ~np.eye(len(names), dtype=bool)
    K = np.kron(np.diag((COMMON**2 + OWN**2) * r**2), np.eye(3)) + np.kron(pair * np.outer(COMMON * r, COMMON * r), MIRRORED)
    A, usual = np.linalg.inv(K), _usual_m(fit).ravel()
    g = A @ usual
    for s in seen:
        at = np.s_[3 * s.joint : 3 * s.joint + 3]
        if s.likely(usual[at], K[at, at]):
            A[at, at] += s.R.T @ s.M @ s.R
            g[at] += s.R.T @ s.Mu
    return A, g


def _usual_m(fit: FitContext) -> np.ndarray:
    """m (J, 3) [m]; zero where keypoints determine a joint, and not the surface alone."""
    usual = np.array([fit.model.joint_places_m.get(name, np.zeros(3)) for name in fit.parameters.skeleton.joint_names])
    usual[fit.tracks.of_any_frame] = 0.0
    return usual


def _longer_by_usual_places(fit: FitContext) -> np.ndarray:
    """Logarithm (B,) of how much longer the bones of the rest pose are when the joints are in their usual places."""
    skeleton, names = fit.parameters.skeleton, fit.parameters.skeleton.joint_names
    moved = np.array([skeleton.bones[bone].R_rest @ m for (bone, _), m in zip(skeleton.joint_bones, _usual_m(fit))])
    ends = [(names.index(bone.head_joint), names.index(bone.tail_joint)) for bone in skeleton.bones]
    longer_m = [bone.R_rest[:, 1] @ (moved[tail] - moved[head]) for bone, (head, tail) in zip(skeleton.bones, ends)]
    return np.log1p(np.array(longer_m) / [bone.nominal_length_m for bone in skeleton.bones])


def _centres_in_place(parameters: ShapeParameters, before: Sequence[BodyState], motion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The balls' centres (M, 3) with which they lie in the new bones where they lay before, in the middle of the frames."""
    of, lengths = parameters.template.metaballs.bone_index, parameters.body(vector)[0]
    R, head = bone_frames(parameters.skeleton, lengths, motion)
    places = np.stack([s.head_m[of] + np.einsum("mij,mj->mi", s.R[of], s.balls.centres_m(s.lengths_m)) for s in before])
    local = np.einsum("tmji,tmj->tmi", R[:, of], places - head[:, of])
    return np.asarray(np.median(local, axis=0) / lengths[of, None])
