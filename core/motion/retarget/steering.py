"""Rigs that are steered by controls: the bones that deform follow helpers and constraints, and keys belong on the controls.

In the state that a preset names (`properties`, such as FK instead of IK) every control of the body follows another one rigidly, whatever
helpers lie between them in the rig. Those controls alone, hung on each other as they follow each other, are a rig like any other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .rig import Rig


@dataclass(frozen=True, eq=False, kw_only=True)
class Steering:
    """How a family of control rigs is steered."""

    follows: Mapping[str, str]  # by control, the one that it follows; a control that is not named follows nothing
    properties: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by bone: custom properties and their values
    skin: Mapping[str, str] = field(default_factory=dict)  # by control, the bone whose weights the skin has in its place

    def table(self) -> dict[str, dict[str, Any]]:
        """As plain values, in the form of a mapping's file."""
        return {
            "follows": dict(self.follows),
            "skin": dict(self.skin),
            "properties": {bone: dict(values) for bone, values in self.properties.items()},
        }

    def of_controls(self, *chains: Mapping[str, tuple[str, ...]]) -> "Steering | None":
        """This, as long as `chains` (bones by role) name nothing else than its controls."""
        named = {name for table in chains for chain in table.values() for name in chain}
        return self if {*self.follows, *self.follows.values()} >= named else None


def controls_of(rig: Rig, steering: Steering, chains: Mapping[str, tuple[str, ...]]) -> Rig:
    """The controls among `chains` (bones by role) of a control rig, as a rig of their own."""
    wanted = {name for chain in chains.values() for name in chain}

    def above(name: str) -> str | None:
        parent = steering.follows.get(name)
        while parent is not None and parent not in wanted:
            parent = steering.follows.get(parent)
        return parent

    def depth(name: str) -> int:
        parent = above(name)
        return 0 if parent is None else 1 + depth(parent)

    names = sorted((name for name in rig.names if name in wanted), key=depth)
    rows = [rig.index[name] for name in names]
    place = {name: i for i, name in enumerate(names)}
    parents = [place[parent] if (parent := above(name)) is not None else -1 for name in names]
    return Rig(
        names=tuple(names),
        parents=np.array(parents),
        R_rest=rig.R_rest[rows],
        head_m=rig.head_m[rows],
        tail_m=rig.tail_m[rows],
        connected=np.zeros(len(names), dtype=bool),
        inherits_rotation=np.ones(len(names), dtype=bool),
    )
