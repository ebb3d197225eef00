"""The knobs of the fit."""

from dataclasses import dataclass

from ..foundation.settings import knob
from ..geometry.intersection import CLICK_SIGMA_PX

ALGORITHM = "body 31"  # part of the fit's key: raise it when the same input gives another body


@dataclass(frozen=True, kw_only=True, slots=True)
class FitSettings:
    """How the body is fitted to clouds and clicks."""

    method: str = knob("joint", "Pose and shape are adjusted together, or in turns as published.", choices=("joint", "alternating"))
    residual: str = knob(
        "metric", "Surface residual: metric (root of the logarithm) or the paper's field difference.", choices=("metric", "paper")
    )
    balls: str = knob(
        "three",
        "Metaballs of a bone: three; one, to compare; complete: three, then refined in an anatomical arrangement.",
        choices=("three", "one", "complete"),
    )
    segmentation: str = knob("hard", "A point belongs to its nearest limb, or in parts to several.", choices=("hard", "soft"))
    weights: bool = knob(False, "The balls' weights are parameters of the fit too: edges can be sharper or rounder.")
    robust: str = knob("geman-mcclure", "Robust weights of outliers.", choices=("geman-mcclure", "huber"))
    robust_width: float = knob(3.0, "Residual, in robust standard deviations, at which a point loses half its pull.", low=1.0, high=20.0)
    voxel_m: float = knob(0.008, "Points are averaged in voxels of this size.", unit="m", low=0.001, high=0.1)
    model_sigma_m: float = knob(0.004, "Standard deviation of a real body from its metaballs.", unit="m", low=0.0, high=0.05)
    model_patch_m: float = knob(0.06, "Points within a patch of this size share the model's error.", unit="m", low=0.0, high=0.5)
    use_surface: bool = knob(
        True,
        "Fit the body to measured points; without them it is fitted to outlines and keypoints alone, and no surface is measured.",
    )
    cloud: str = knob(
        "measured",
        "The points that attract the body: the whole measured surface, or those that were tracked from frame to frame.",
        choices=("measured", "tracked"),
    )
    complete_surface: bool = knob(
        True, "Where no patch could be matched, fit the body to a coarser surface, by semi-global matching inside the person's outline."
    )
    use_trajectories: bool = knob(
        True, "Tracked points stay at their places in the limbs: they determine twist, sliding, centres of the joints."
    )
    track_again: bool = knob(False, "Track once more with the fitted body, which predicts where and when lost points reappear.")
    closed_loop: str = knob(
        "auto",
        "After the fit, track once more with the body, and fit again: to the longer trajectories (tracks), and to the outlines that "
        "trajectories and body predict (outlines); or fit once (off). auto: what is most accurate for its cost, at present off.",
        choices=("auto", "off", "tracks", "outlines"),
    )
    search_limbs: bool = knob(
        True,
        "Limbs that lost their points, or leave what is seen near them unexplained, are searched for all over the joints' range; without, "
        "each frame starts from its prediction alone, as published.",
    )
    track_sigma_m: float = knob(0.001, "How far a tracked point moves on its limb from frame to frame.", unit="m", low=0.0, high=0.05)
    shared_frames: float = knob(
        1.0,
        "Frames over which the model's error is the same; the prior of the shape weighs as much more (balls=one: all).",
        low=1.0,
        high=1e5,
    )
    use_contours: bool = knob(True, "Fit the body to the views' outlines (tricap contour).")
    use_background: bool = knob(
        True,
        "Fit the body to the person's outline before the still background, and keep it inside (cameras and background must stand still).",
    )
    background_sigma_px: float = knob(
        4.0, "Sigma of the person's outline against the background.", unit="px", low=0.5, high=50.0, was=("empty_sigma_px",)
    )
    gate_m: float = knob(0.035, "A point further than this from a limb's surface does not belong to it.", unit="m", low=0.005, high=0.3)
    outline_gate_m: float = knob(0.10, "A ray of an outline further than this from every limb is ignored.", unit="m", low=0.005, high=1.0)
    floor: bool = knob(False, "A standing foot has the height that feet have when they stand (world: Z up, a level floor).")
    click_sigma_px: float = knob(
        CLICK_SIGMA_PX,
        "Sigma of a click. Clicks of one point are refused if the residual of their rays exceeds three times this.",
        unit="px",
        low=0.1,
        high=100.0,
    )
    least_start_probability: float = knob(
        0.95, "Without clicks: a start that is less probable is not used; the fit asks for the click that decides.", low=0.0, high=1.0
    )
    place_joints: str = knob(
        "auto",
        "Joints lie in the body where they usually lie, and where they were clicked, in any frame: on, off, or auto (of bodies with a left "
        "and a right side, whose clicks confirm each other).",
        choices=("auto", "on", "off"),
    )
    length_sigma: float = knob(
        0.15, "Relative sigma of the lengths between clicked joints, about a person of the model's proportions.", low=0.001, high=1.0
    )
    proportion_sigma: float = knob(
        0.04, "Relative sigma of one bone about other people's of that size; all frames count as one.", low=0.001, high=1.0
    )
    radius_sigma: float = knob(0.2, "Relative sigma of the model's radii.", low=0.001, high=1.0)
    roundness_sigma: float = knob(0.10, "Relative sigma of the difference of a ball's two cross radii.", low=0.001, high=1.0)
    evenness_sigma: float = knob(
        0.4,
        "Relative sigma of a ball's thickness against its neighbours', about the model: after the fit, rings that no measurement supports "
        "are smoothed.",
        low=0.001,
        high=100.0,
    )
    symmetry_sigma: float = knob(
        0.015,
        "Relative sigma of the difference of a bone's lengths on the left and on the right; all frames "
        "count as one. Of radii it is twice that, in each frame.",
        low=0.001,
        high=1.0,
    )
    limit_sigma_deg: float = knob(2.0, "Sigma of joint limits: how far a joint may exceed them.", unit="deg", low=0.1, high=30.0)
    prediction_sigma_deg: float = knob(15.0, "Sigma of an angle predicted from the frames before.", unit="deg", low=0.5, high=90.0)
    prediction_sigma_m: float = knob(0.03, "Sigma of a position predicted from the frames before.", unit="m", low=0.001, high=1.0)
    acceleration_deg_s2: float = knob(
        6000.0, "Typical angular acceleration, for the adjustment over time.", unit="deg/s²", low=1.0, high=1e6
    )
    acceleration_m_s2: float = knob(5.0, "Typical acceleration of the base, for the adjustment over time.", unit="m/s²", low=0.01, high=1e4)
    frame_steps: int = knob(6, "Most steps of the adjustment of one frame.", low=1, high=100)
    sequence_steps: int = knob(30, "Most steps of the adjustment over the whole sequence.", low=0, high=200)
    min_points: int = knob(25, "A bone with fewer points in a frame counts as not observed.", low=1, high=10000)
