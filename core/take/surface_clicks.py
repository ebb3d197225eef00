"""Which clicks the surface follows."""

from dataclasses import replace

from ..body.model_file import read_model
from ..body.trunk import suffice_for_pose
from .take import START_ALONE, WHOLE_BODY, FrameClicks, Take


def surface_clicks(take: Take, *, automatic_seeds: bool) -> FrameClicks:
    """Those of a take's clicks in [seeds] that say where and from which frame the surface is measured.

    A body that can start alone needs no clicks. Joints from which it could not begin anyhow answer a question or correct a fit, and leave
    what is measured as it is. Where no seeds are found automatically, all clicks are needed.
    """
    clicks = take.clicks
    if not clicks.joints or not automatic_seeds or take.body_model not in START_ALONE:
        return clicks
    located = {name for name, at in clicks.joints.items() if len(at) > 1}
    if suffice_for_pose(located, read_model(WHOLE_BODY).skeleton):
        return clicks
    return replace(clicks, joints={}) if clicks.surface else FrameClicks()
