"""Cameras whose names are not those of the views: which camera is which, by the words in their names, else by their order."""

from collections.abc import Sequence

from ..foundation.errors import InputError
from ..geometry.rig import Rig
from ..take.footage_files import side_of_name


def names_for_views(rig: Rig, views: Sequence[str]) -> dict[str, str]:
    """The view of each camera whose name has to change, by the camera's name; empty if every view has a camera of its name.

    Names that differ in upper and lower case only, and words for the same side (left, L), belong together. Where that leaves any open,
    as many cameras as views are taken in their order.

    Raises:
        InputError: there are fewer cameras than views, or more and their names do not show which are meant.
    """
    names = [camera.name for camera in rig.cameras]
    if set(views) <= set(names):
        return {}
    for key in (str.casefold, lambda name: side_of_name(name) or name.casefold()):
        known = {key(name): name for name in names}
        if len(known) == len(names) and len({key(view) for view in views}) == len(views) and all(key(view) in known for view in views):
            return {known[key(view)]: view for view in views if known[key(view)] != view}
    if len(names) != len(views):
        raise InputError(
            f"The calibration has {len(names)} cameras ({', '.join(names)}), the project {len(views)} views ({', '.join(views)}), and the "
            "names do not show which belong together. Give the views the names of their cameras (step 1)."
        )
    return {name: view for name, view in zip(names, views) if name != view}
