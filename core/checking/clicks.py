"""Clicks that are missing, contradict each other or lie on the room instead of the person."""

import numpy as np

from ..body.model_file import read_model
from ..clicked_points import clicked_depth
from ..errors import InputError
from ..matching.foreground import unchanged
from ..take import Clicks, Footage, Take
from .findings import Finding, doubtful, wrong

FAR_M = 1.0  # in depth: more than a stretched-out arm reaches from the body

LIMBS = {f"{side} {limb}": tuple(f"{joint}.{side[0].upper()}" for joint in joints) for side in ("right", "left")
         for limb, joints in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle")))}  # fmt: skip


def joint_findings(take: Take) -> list[Finding]:
    """A body that is wanted and not clicked, or limbs of it: which way a limb goes is what the fit takes from clicks.

    Raises:
        InputError: there is no such body model.
    """
    if take.body_model is None or take.keypoints:
        return []
    joints = read_model(take.body_model).skeleton.joint_names
    clicked = {name for seeds in (take.seeds, *take.keyframes) for name, at in seeds.joints.items() if len(at) > 1}
    advice = "Click them in Blender (step 3), or write them under [seeds.joints] of take.toml, in two views at least."
    if not clicked:
        sentence = f"No joint of the body “{take.body_model}” is clicked: there will be surface and tracks, but no body."
        return [doubtful("no clicks", sentence, advice)]
    bare = [limb for limb, names in LIMBS.items() if {*names} <= {*joints} and len(clicked & {*names}) < 2]
    if not bare:
        return []
    said = ", ".join(bare)
    return [doubtful("few clicks", f"Fewer than two joints are clicked of: {said}. The fit has to guess where they are.", advice)]


def seed_findings(footage: Footage) -> list[Finding]:
    """Clicks without a place in space, far behind the others, or surface seeds on what never moves."""
    seeds, found, depth = footage.take.seeds, [], dict[str, float]()
    labelled: list[tuple[str, Clicks]] = [*seeds.joints.items(), *((f"surface seed {i + 1}", at) for i, at in enumerate(seeds.surface))]
    for name, at in labelled:
        try:
            depth[name] = clicked_depth(footage, name, at)
        except InputError as error:
            found.append(wrong("clicks", str(error)))
    middle = float(np.median(list(depth.values()))) if depth else 0.0
    far = {name: d for name, d in depth.items() if abs(d - middle) > FAR_M}
    for name, d in far.items():
        advice = "Is it on the background, or clicked on different spots in the views? Click it again."
        found.append(doubtful("clicks", f"The click “{name}” is {abs(d - middle):.1f} m away from the others in depth.", advice, depth_m=d))
    rest = [i for i in _resting(footage) if f"surface seed {i + 1}" not in far]
    if rest:
        said = ", ".join(str(i + 1) for i in rest)
        advice = "Is it on the background? What is measured is taken from the clicks' depths; click it on the person."
        found.append(doubtful("seed on the background", f"Surface seed {said} lies on something that never moves.", advice))
    return found


def _resting(footage: Footage) -> list[int]:
    """Surface seeds (their numbers from 0) around which the reference picture is the same in the frame furthest in time."""
    take, name = footage.take, footage.take.reference_view
    frame = take.seeds.frame
    clicked = [i for i, at in enumerate(take.seeds.surface) if name in at]
    other = max(footage.frames, key=lambda f: abs(f - frame))
    if not clicked or other == frame:
        return []
    here, later = (take.rows_at(f).rows(footage.read(f)[take.reference]) for f in (frame, other))
    xy = take.rows_at(frame).from_frame(np.array([take.seeds.surface[i][name] for i in clicked]))
    xy = np.clip(xy, 0, np.array(here.shape[::-1]) - 1)
    return [i for i, same in zip(clicked, unchanged(here, later, xy)) if same]
