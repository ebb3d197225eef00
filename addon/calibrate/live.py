"""How many whole bars each camera has seen so far, while the job runs: written by the job, drawn by the panel."""

from ..session import get_session

GOOD, FAIR = 100, 30  # whole bars in a view


def begin() -> None:
    """Forget what was counted before."""
    get_session().file.bar_counts.clear()


def note(view: str, frames: int, whole: int) -> None:
    """`whole` of the first `frames` images of a view show both targets."""
    get_session().file.bar_counts[view] = (frames, whole)


def counts() -> dict[str, tuple[int, int]]:
    """Frames looked at and whole bars seen, by view."""
    return dict(get_session().file.bar_counts)


def light(whole: int) -> str:
    """The icon of a count: red, yellow, green."""
    return "STRIP_COLOR_04" if whole >= GOOD else "STRIP_COLOR_03" if whole >= FAIR else "STRIP_COLOR_01"
