"""What the phases of a run usually cost: for one progress bar over all of them."""

from collections.abc import Sequence

from ..foundation.progress import Course

# Names as in Monitor.step -> seconds once and a frame: a whole body in three views of 768×576 pixels, on two cores
COST: dict[str, dict[str, tuple[float, float]]] = {
    "measure": {"seeds": (2.0, 0.15), "surface": (0.5, 0.35)},
    "track": {"tracks": (0.5, 0.25)},
    "fit": {
        "background": (0.5, 0.08),
        "coarse surface": (0.2, 0.2),
        "fit the click frame": (6.0, 0.0),
        "fit frame after frame": (0.0, 0.4),
        "follow the limbs": (0.0, 0.25),
        "turn the hands": (0.0, 0.05),
        "adjust the sequence": (0.0, 0.36),
        "sigmas of the fit": (0.5, 0.12),
        "relief": (7.0, 0.03),
        "texture": (4.0, 0.0),
        "skin": (0.4, 0.02),
        "silhouettes": (2.5, 0.0),
    },
    "report": {"report": (2.5, 0.01)},
}
WITHOUT_SURFACE = "fit without a surface"
_OUTLINES = {"background": COST["fit"]["background"], "follow points": (6.0, 0.9)}
COST[WITHOUT_SURFACE] = _OUTLINES | {name: cost for name, cost in COST["fit"].items() if name not in (*_OUTLINES, "coarse surface")}


def course_of(stages: Sequence[str], frames: int, *, surface: bool = True) -> Course:
    """The progress of some stages of a run over so many frames; without a `surface` there is nothing to measure and to track."""
    if not surface:
        stages = [WITHOUT_SURFACE if stage == "fit" else stage for stage in stages if stage not in ("measure", "track")]
    return Course([(name, once + frames * each) for stage in stages for name, (once, each) in COST[stage].items()])
