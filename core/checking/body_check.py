"""A fitted body whose limbs have odd proportions: a joint was clicked in another's place."""

from ..body.model_file import read_model
from ..body.shape import BodyShape, default_shape

PARTS = (("upper_arm", "forearm"), ("thigh", "shin"))
ODD = 1.4  # times the model's proportion; fitted limbs come within 1.3, an elbow clicked at the wrist makes 1.6


def odd_limbs(shape: BodyShape) -> list[str]:
    """A sentence for each limb of which one part is far too long beside the other."""
    usual = default_shape(read_model(shape.model)).lengths_m
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
