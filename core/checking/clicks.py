"""Clicks that contradict each other or lie on the room instead of the person."""

import numpy as np

from ..clicked_points import clicked_depth
from ..errors import InputError
from ..matching.foreground import unchanged
from ..take import Clicks, Footage
from .findings import Finding, doubtful, wrong

FAR_M = 1.0  # in depth: more than a stretched-out arm reaches from the body


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
