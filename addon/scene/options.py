"""What a scene is built by, and the properties that a built one is known by: importing this loads no builder."""

from dataclasses import dataclass

from ...core.body.fields import EXPONENTIAL
from ...core.body.skin.mesh import DETAIL

POINTS_KEY = "tricap_points"  # custom property of the collection Measured: cloud and trajectories
OUT_KEY = "tricap_out"  # custom property of the collection: the folder that it was built from
PART_KEY = "tricap_part"  # custom property of the collections in it: Body, Cameras, Measured, …
PLACES_KEY = "tricap_places"  # custom property of the collection: folders of results ("out") and take, relative to the .blend
KEYS_KEY = "tricap_keys"  # custom property of the collection: the keys of the finished stages (core/run/stages.py)


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """The user's choices for a scene."""

    detail: int = DETAIL  # of the skin: pieces per edge
    exact_skin: bool = False  # also the skin cast in every frame: a mesh cache next to the .blend
    implicit: bool = False  # also the implicit surface itself
    field: str = EXPONENTIAL.name  # of the implicit surface, one of core.body.fields.POTENTIALS
    rest_pose: str = "A"  # of the armature, one of rest_pose.POSES
    simplify_deg: float = 0.0  # above 0: the armature plays a second action with fewer keys, within this tolerance
    colour: str = "intensity"  # of the cloud, one of cloud.COLOURS
    arrows: bool = False  # velocities and accelerations as arrows
    studio: bool = True  # lights, floor and background
    frame: int | None = None  # of the implicit surface; None: the middle one
    most_points: int = 300_000  # of the cloud, and of the trajectories, in all frames together; more are thinned evenly


DEFAULTS = SceneOptions()
