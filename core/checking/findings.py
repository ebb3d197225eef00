"""A finding: one thing that is wrong or doubtful, what it comes from, and what to do about it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """`cause` names the kind of fault in a word or two, for machines; `sentence` and `advice` are for people. What is certain is wrong and
    spoils the measurement; what is not certain deserves a look. `figures` carries the numbers with their units in their names."""

    cause: str
    sentence: str
    advice: str
    certain: bool = True
    figures: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        """One line for a terminal."""
        return f"{'Wrong' if self.certain else 'Doubtful'}: {self.sentence} {self.advice}"

    def to_table(self) -> dict[str, Any]:
        """As a plain table, for JSON."""
        return asdict(self) | {"figures": dict(self.figures)}


def wrong(cause: str, sentence: str, advice: str = "", **figures: Any) -> Finding:
    """Something that spoils the measurement."""
    return Finding(cause=cause, sentence=sentence, advice=advice, figures=figures)


def doubtful(cause: str, sentence: str, advice: str = "", **figures: Any) -> Finding:
    """Something that deserves a look."""
    return Finding(cause=cause, sentence=sentence, advice=advice, certain=False, figures=figures)


@dataclass(frozen=True, kw_only=True, slots=True)
class Checked:
    """All that was found about one take, rig or result; `figures` says what was looked at and how good it is where nothing is wrong."""

    subject: str
    kind: str
    findings: tuple[Finding, ...]
    figures: Mapping[str, Any]

    def lines(self) -> list[str]:
        """The findings, or that there are none."""
        return [f"{self.subject}: nothing to complain about."] if not self.findings else [str(f) for f in self.findings]

    def to_table(self) -> dict[str, Any]:
        """As a plain table, for JSON."""
        return {
            "subject": self.subject,
            "kind": self.kind,
            "good": not self.findings,
            "findings": [f.to_table() for f in self.findings],
            "figures": dict(self.figures),
        }
