"""Control rigs: rigs whose deforming bones follow helpers and constraints, so that keys belong on the controls.

In the state that a preset defines (`properties`, such as FK instead of IK) every control of the body follows another one rigidly, whatever
helpers lie between them in the rig. The controls alone, with these as parents, are a rig like any other.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .rig import Rig


@dataclass(frozen=True, eq=False, kw_only=True)
class ControlRig:
    """The controls of a family of rigs."""

    follows: Mapping[str, str]  # by control, the one that it follows; a control that is not named follows none
    properties: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # by bone: custom properties and their values
    skin: Mapping[str, str] = field(default_factory=dict)  # by control, the bone that has the skin's weights instead

    def table(self) -> dict[str, dict[str, Any]]:
        """As plain values, as in a mapping file."""
        return {
            "follows": dict(self.follows),
            "skin": dict(self.skin),
            "properties": {bone: dict(values) for bone, values in self.properties.items()},
        }

    def of_controls(self, *chains: Mapping[str, tuple[str, ...]]) -> "ControlRig | None":
        """This control rig if all bones of `chains` (by role) are its controls, else None."""
        named = {name for table in chains for chain in table.values() for name in chain}
        return self if {*self.follows, *self.follows.values()} >= named else None


def controls_of(rig: Rig, control_rig: ControlRig, chains: Mapping[str, tuple[str, ...]]) -> Rig:
    """The controls in `chains` (bones by role) as a rig of their own."""
    wanted = {name for chain in chains.values() for name in chain}

    def above(name: str) -> str | None:
        parent = control_rig.follows.get(name)
        while parent is not None and parent not in wanted:
            parent = control_rig.follows.get(parent)
        return parent

    def depth(name: str) -> int:
        parent = above(name)
        return 0 if parent is None else 1 + depth(parent)

    names = sorted((name for name in rig.names if name in wanted), key=depth)
    rows = [rig.index[name] for name in names]
    order = {name: i for i, name in enumerate(names)}
    parents = [order[parent] if (parent := above(name)) is not None else -1 for name in names]
    return Rig(
        names=tuple(names),
        parents=np.array(parents),
        R_rest=rig.R_rest[rows],
        head_m=rig.head_m[rows],
        tail_m=rig.tail_m[rows],
        connected=np.zeros(len(names), dtype=bool),
        inherits_rotation=np.ones(len(names), dtype=bool),
    )
