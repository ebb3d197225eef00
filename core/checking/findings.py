"""A finding: one fault or doubt, its cause, and what to do about it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any


class Cause(StrEnum):
    """The kind of fault, for programs; the values are those of `tricap check --json`."""

    BACKGROUND = "background"
    BLANK_VIEW = "blank view"
    CLICKS = "clicks"
    CLOTHES = "clothes"
    COMBING = "combing"
    COVERAGE = "coverage"
    DARK = "dark"
    FAR_APART = "far apart"
    FEW_CLICKS = "few clicks"
    FILES_MISSING = "files missing"
    FOREIGN_RIG = "foreign rig"
    FRAMES_MISSING = "frames missing"
    FRAME_RATE = "frame rate"
    FROZEN_VIEW = "frozen view"
    IDENTICAL_VIEWS = "identical views"
    INPUT = "input"
    LARGE_SIGMA = "large sigma"
    NO_CLICKS = "no clicks"
    NO_COMMON_VIEW = "no common view"
    NO_MATCHES = "nothing in common"
    NO_TEXTURE = "no texture"
    NOT_FINISHED = "not finished"
    NOT_SYNCHRONISED = "out of step"
    ODD_CAMERA = "odd camera"
    ONE_CAMERA = "one camera"
    OVEREXPOSED = "overexposed"
    POOR_CALIBRATION = "poor calibration"
    RAYS_MISS = "rays miss"
    REFERENCE_VIEW = "reference view"
    REPEATED_FRAMES = "repeated frames"
    ROLLING_SHUTTER = "rolling shutter"
    SAME_PLACE = "same place"
    SEED_ON_BACKGROUND = "seed on the background"
    STALE_CALIBRATION = "stale calibration"
    STALE_RESULT = "stale result"
    SWAPPED_VIEWS = "swapped views"
    UNIT = "unit"
    VARIABLE_FRAME_RATE = "variable frame rate"
    WARNING = "warning"
    WEAK_TEXTURE = "weak texture"


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """`sentence` and `advice` are for people. A `certain` finding is an error that spoils the measurement; others deserve a look. A
    `harmless` one is a remark, which does not count as a finding of a check.

    `figures` holds the numbers, with their units in their names.
    """

    cause: Cause
    sentence: str
    advice: str
    certain: bool = True
    harmless: bool = False
    figures: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        """One line for a terminal."""
        kind = "Note" if self.harmless else "Wrong" if self.certain else "Doubtful"
        return f"{kind}: {self.sentence} {self.advice}".rstrip()

    def to_table(self) -> dict[str, Any]:
        """As a plain table, for JSON."""
        table = asdict(self) | {"cause": self.cause.value, "figures": dict(self.figures)}
        del table["harmless"]  # those are notes
        return table


def wrong(cause: Cause, sentence: str, advice: str = "", **figures: Any) -> Finding:
    """An error that spoils the measurement."""
    return Finding(cause=cause, sentence=sentence, advice=advice, figures=figures)


def doubtful(cause: Cause, sentence: str, advice: str = "", **figures: Any) -> Finding:
    """Something that deserves a look."""
    return Finding(cause=cause, sentence=sentence, advice=advice, certain=False, figures=figures)


def remark(cause: Cause, sentence: str, advice: str = "", **figures: Any) -> Finding:
    """Something to know that harms nothing."""
    return Finding(cause=cause, sentence=sentence, advice=advice, certain=False, harmless=True, figures=figures)


@dataclass(frozen=True, kw_only=True, slots=True)
class Checked:
    """The findings about one take, rig or result; `figures` are the quantities examined, also where nothing is wrong."""

    subject: str
    kind: str
    findings: tuple[Finding, ...]
    figures: Mapping[str, Any]
    notes: tuple[str, ...] = ()  # lines that are no findings

    def lines(self) -> list[str]:
        """The findings, or a line that there are none; then the notes."""
        return [*([f"{self.subject}: no problems found."] if not self.findings else map(str, self.findings)), *self.notes]

    def to_table(self) -> dict[str, Any]:
        """As a plain table, for JSON."""
        return {
            "subject": self.subject,
            "kind": self.kind,
            "good": not self.findings,
            "findings": [f.to_table() for f in self.findings],
            "figures": dict(self.figures),
            "notes": list(self.notes),
        }
