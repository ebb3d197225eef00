"""Which balls add up in a skin of metaballs that knows no places: families, of whose fields the largest counts.

In the fit the surface of bone b is that of its own balls and of those of the bones that it meets (F_b, `metaballs`). One family for each
bone's F_b would web an arm to the flank beside it, and a leg to the other. So:

    a part            its own chain of bones
    a trunk           … and the short bones within it on which limbs hang: shoulders
    a limb            … that hangs on the trunk by a long bone, a thigh: and the balls of the trunk's bone there
    a trunk's bone    on which such limbs hang: its own balls, what is next to it of the trunk, and the upper balls of the limbs

Against the largest F_b beside its bone, seven postures of five fitted persons: 0.9 mm RMS (with the parts alone 4.9), hips 2.1 (20), neck
0.8 (8), shoulders 3.0 (9.8): there F_b holds beside a short bone alone. Where limbs touch, as in a squat, the sum is up to 20 mm thicker.
"""

from collections.abc import Sequence

import numpy as np

from .shape import BodyShape
from .skin_parts import Part, body_parts

UPPER = 0.6  # balls of a limb up to here along its first bone count for the trunk's bone
NEXT_TO = 0.34  # and those of the trunk's next bone up to here


def families(shape: BodyShape) -> list[np.ndarray]:
    """The balls (numbers of `shape.metaballs`, rising by the bone's place in the family) of each family; first those of the parts."""
    parts = body_parts(shape)
    found = [_balls(shape, _bones(parts, p)) for p in range(len(parts))]
    for attachment in sorted({part.attachment for part in parts if _is_long(part) and part.attachment is not None}):
        limbs = [part.bones[0] for part in parts if _is_long(part) and part.attachment == attachment]
        trunk = next(part for part in parts if attachment in part.bones)
        beyond = trunk.bones[trunk.bones.index(attachment) + 1 :][:1]
        found.append(np.concatenate([_balls(shape, (attachment,)), _balls(shape, beyond, NEXT_TO), _balls(shape, limbs, UPPER)]))
    return found


def _is_long(limb: Part) -> bool:
    """Whether a limb leaves the trunk by its first bone."""
    return limb.parent is not None and len(limb.junction) == 1


def _bones(parts: tuple[Part, ...], p: int) -> tuple[int, ...]:
    part = parts[p]
    short = tuple(limb.bones[0] for limb in parts if limb.parent == p and not _is_long(limb))
    above = (part.attachment,) if _is_long(part) and part.attachment is not None else ()
    return (*part.bones, *short, *above)


def _balls(shape: BodyShape, bones: Sequence[int], up_to: float = np.inf) -> np.ndarray:
    balls = shape.metaballs
    found = [np.flatnonzero((balls.bone_index == b) & (balls.centre[:, 1] < up_to)) for b in bones]
    return np.concatenate([np.zeros(0, dtype=np.intp), *found])
