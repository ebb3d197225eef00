"""A fitted body that cannot be right: limbs of odd proportions (a joint was clicked in another's place), joints that do not lie where they
were clicked, and angles beyond what joints allow."""

import numpy as np

from ..body.model_file import read_model, with_limits
from ..body.motion import BodyFit, BodyMotion
from ..body.shape import BodyShape
from ..fitting.inputs.fit_input import FitInput

PARTS = (("upper_arm", "forearm"), ("thigh", "shin"))
ODD = 1.4  # times the model's proportion; fitted limbs come within 1.3, an elbow clicked at the wrist makes 1.6
OFF_CLICK = 6.0  # sigmas of a click, in the median view
BEYOND_LIMIT_DEG = 15.0
MOST_TOLD = 3  # joints of one kind


def check_fit(given: FitInput, body: BodyFit, click_sigma_px: float) -> list[str]:
    """All sentences about a fitted body; `click_sigma_px` is that of a click."""
    return [*odd_limbs(body.shape), *clicks_not_kept(given, body.motion, click_sigma_px), *limits_not_kept(given, body.motion)]


def odd_limbs(shape: BodyShape) -> list[str]:
    """A sentence for each limb of which one part is far too long beside the other."""
    usual = np.array([bone.nominal_length_m for bone in shape.skeleton.bones])
    names = [bone.name for bone in shape.skeleton.bones]
    longer = {name: float(ratio) for name, ratio in zip(names, shape.lengths_m / usual)}
    said = []
    for upper, lower in ((f"{a}.{s}", f"{b}.{s}") for a, b in PARTS for s in "LR"):
        if upper not in longer or lower not in longer:
            continue
        times = longer[upper] / longer[lower]
        if not 1 / ODD < times < ODD:
            long, short = (upper, lower) if times > 1 else (lower, upper)
            joint = shape.skeleton.bones[names.index(upper)].tail_joint
            said.append(
                f"{long} came out {max(times, 1 / times):.1f} times too long beside {short}: were {joint} and its neighbours clicked under "
                "their own names? Look at the pictures of the body."
            )
    return said


def clicks_not_kept(given: FitInput, motion: BodyMotion, sigma_px: float) -> list[str]:
    """A sentence about the joints that lie far from where they were clicked, the worst first; `sigma_px` is that of a click."""
    found = []
    for frame, joints in given.clicks.items():
        places = dict(zip(motion.joint_names, motion.joints_m[list(motion.frames).index(frame)]))
        for name, views in joints.items():
            if name not in places or not views:
                continue
            off = float(np.median([np.linalg.norm(given.rig[view].project(places[name]) - xy) for view, xy in views.items()]))
            if off > OFF_CLICK * sigma_px:
                found.append((off, f"{name} by {off:.0f} px in frame {frame}"))
    if not found:
        return []
    told = ", ".join(sentence for _, sentence in sorted(found, reverse=True)[:MOST_TOLD])
    more = f" and {len(found) - MOST_TOLD} more" if len(found) > MOST_TOLD else ""
    return [
        f"The body does not lie where it was clicked: {told}{more}. Look at those clicks and at the pictures of the body; clicks in "
        "frames between help."
    ]


def limits_not_kept(given: FitInput, motion: BodyMotion) -> list[str]:
    """A sentence about the angles that are far beyond what their joints allow, the worst first."""
    skeleton = with_limits(read_model(given.model), given.limits, given.locked).skeleton
    low, high = np.degrees([dof.limits for dof in skeleton.dofs]).T
    values = np.degrees(motion.values)
    beyond = np.maximum(values - high, low - values)
    beyond[:, skeleton.layout.group("base")] = 0.0  # a place, no angle
    worst = np.argsort(-beyond.max(axis=0), kind="stable")
    told = [
        f"{skeleton.dofs[d].name} by up to {beyond[:, d].max():.0f}° (frame {motion.frames[int(beyond[:, d].argmax())]})"
        for d in worst
        if beyond[:, d].max() > BEYOND_LIMIT_DEG
    ]
    if not told:
        return []
    more = f" and {len(told) - MOST_TOLD} more" if len(told) > MOST_TOLD else ""
    return [
        f"Joints are bent further than they can: {', '.join(told[:MOST_TOLD])}{more}. The limb may have been taken for another way "
        "round: click its joints in such a frame, or widen the angle under [body.limits]."
    ]
