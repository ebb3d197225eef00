"""A fitted body that is implausible: limbs of odd proportions (a joint was clicked in place of another), joints far from their clicks, and
angles beyond the limits of their joints."""

import numpy as np

from ..body.model_file import read_model, with_limits
from ..body.motion import BodyFit, BodyMotion
from ..body.shape import BodyShape
from ..fitting.inputs.fit_input import FitInput

LIMBS = (("upper_arm", "forearm"), ("thigh", "shin"))
ODD_RATIO = 1.4  # times the model's proportion; fitted limbs come within 1.3, an elbow clicked at the wrist makes 1.6
FAR_SIGMAS = 6.0  # of a click, in the median view
BEYOND_LIMIT_DEG = 15.0
MOST_NAMED = 3  # joints of one kind


def check_fit(given: FitInput, body: BodyFit, click_sigma_px: float) -> list[str]:
    """All warnings about a fitted body; `click_sigma_px` is the sigma of a click."""
    return [*odd_limbs(body.shape), *far_from_clicks(given, body.motion, click_sigma_px), *beyond_limits(given, body.motion)]


def odd_limbs(shape: BodyShape) -> list[str]:
    """A warning for each limb with one part far too long for the other."""
    usual = np.array([bone.nominal_length_m for bone in shape.skeleton.bones])
    names = [bone.name for bone in shape.skeleton.bones]
    relative = {name: float(ratio) for name, ratio in zip(names, shape.lengths_m / usual)}
    warnings = []
    for upper, lower in ((f"{a}.{s}", f"{b}.{s}") for a, b in LIMBS for s in "LR"):
        if upper not in relative or lower not in relative:
            continue
        ratio = relative[upper] / relative[lower]
        if not 1 / ODD_RATIO < ratio < ODD_RATIO:
            long, short = (upper, lower) if ratio > 1 else (lower, upper)
            joint = shape.skeleton.bones[names.index(upper)].tail_joint
            warnings.append(
                f"{long} is {max(ratio, 1 / ratio):.1f} times too long for {short}: is {joint}, or a joint next to it, clicked in the "
                "wrong place or under another name? Look at the pictures of the body."
            )
    return warnings


def far_from_clicks(given: FitInput, motion: BodyMotion, sigma_px: float) -> list[str]:
    """A warning about the joints that lie far from their clicks, the worst first; `sigma_px` is the sigma of a click."""
    far = []
    for frame, joints in given.clicks.items():
        fitted_m = dict(zip(motion.joint_names, motion.joints_m[list(motion.frames).index(frame)]))
        for name, views in joints.items():
            if name not in fitted_m or not views:
                continue
            off = float(np.median([np.linalg.norm(given.rig[view].project(fitted_m[name]) - xy) for view, xy in views.items()]))
            if off > FAR_SIGMAS * sigma_px:
                far.append((off, f"{name} by {off:.0f} px in frame {frame}"))
    if not far:
        return []
    worst = ", ".join(text for _, text in sorted(far, reverse=True)[:MOST_NAMED])
    more = f" and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
    return [
        f"Fitted joints are far from their clicks: {worst}{more}. Check those clicks and the pictures of the body; more clicks in frames "
        "in between help."
    ]


def beyond_limits(given: FitInput, motion: BodyMotion) -> list[str]:
    """A warning about the angles far beyond the limits of their joints, the worst first."""
    skeleton = with_limits(read_model(given.model), given.limits, given.locked).skeleton
    low, high = np.degrees([dof.limits for dof in skeleton.dofs]).T
    values = np.degrees(motion.values)
    beyond = np.maximum(values - high, low - values)
    beyond[:, skeleton.layout.group("base")] = 0.0  # a position, no angle
    worst = np.argsort(-beyond.max(axis=0), kind="stable")
    far = [
        f"{skeleton.dofs[d].name} by up to {beyond[:, d].max():.0f}° (frame {motion.frames[int(beyond[:, d].argmax())]})"
        for d in worst
        if beyond[:, d].max() > BEYOND_LIMIT_DEG
    ]
    if not far:
        return []
    more = f" and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
    return [
        f"Joint angles exceed their limits: {', '.join(far[:MOST_NAMED])}{more}. The limb may be bent the wrong way: click its joints in "
        "such a frame, or widen the limits under [body.limits]."
    ]
