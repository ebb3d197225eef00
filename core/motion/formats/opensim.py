"""OpenSim: a skeleton model scaled to the person (.osim) and its coordinates over time (.mot).

Every bone is a body whose frame is parallel to the ground's while the rig rests, so that all coordinates are zero in the rest pose:

    D_b = R_b · R_rest,bᵀ                        rotation of a bone since its rest pose, in the world          (1)
    A · D_parentᵀ · D_b · Aᵀ = Rz(a) Rx(b) Ry(c)  the joint's coordinates; A turns the world to OpenSim's axes  (2)

The bones without a parent, and those whose heads move relative to their parents, have three translations [m] as well. Masses are unknown:
each body has 1 kg, so the model is for kinematics, not for dynamics.
"""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...geometry.rotation import euler_from_matrix, transposed
from ...images.interlace import frame_time_s
from ..retarget.rig import Motion, Rig, head_of
from .markers import AXES

TURNS = ("rz", "rx", "ry")  # the first one turns about the axis of the parent
AXIS = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
MOVES = 5e-5  # metres: a head that moves less relative to its parent is rigidly attached
MARK = "<!-- As Tricap wrote it: "  # and a digest of all before it
CREDITS = "Written by Tricap for kinematics: lengths are measured, masses are not."
MODEL_BYTES = 1 << 26  # of an earlier export
MASS_KG, INERTIA = "1", "0.01 0.01 0.01 0 0 0"


def write_opensim(path: Path, motion: Motion, *, names: dict[str, str] | None = None) -> None:
    """Write the motion to `path` (.mot), and next to it, with the ending .osim, the model that it moves.

    `names`: other names by those of the bones. Angles are written in degrees, translations in metres.

    Raises:
        InputError: a file cannot be written, or the model's would replace one that is not of an earlier export.
    """
    _check_replaceable(Path(path).with_suffix(".osim"))
    A, rig = AXES["OpenSim"], motion.rig
    bodies = component_names([(names or {}).get(name, name) for name in rig.names])
    since_rest = motion.R @ transposed(rig.R_rest)  # (1)
    time_s = frame_time_s(motion.frames - motion.frames[0], motion.fps)
    columns, moving = {"time": time_s}, set[int]()
    for b, body in enumerate(bodies):
        a = int(rig.parents[b])
        local = since_rest[:, b] if a < 0 else transposed(since_rest[:, a]) @ since_rest[:, b]
        angles = np.degrees(euler_from_matrix(A @ local @ A.T, "YXZ"))  # (2): the last letter is the first factor
        columns |= {f"{body}_{turn}": angles[:, "xyz".index(turn[1])] for turn in TURNS}
        shift_m = _shift(motion, b) @ A.T
        if a < 0 or float(np.abs(shift_m).max()) > MOVES:
            moving.add(b)
            columns |= {f"{body}_t{axis}": shift_m[:, i] for i, axis in enumerate("xyz")}
    path = Path(path)
    store.write_bytes(path.with_suffix(".osim"), _model(path.stem, rig, bodies, moving, A))
    store.write_text(path, _storage(path.stem, columns))


def _check_replaceable(model: Path) -> None:
    try:
        ours = not model.exists() or _is_as_written(bounded.bytes_of(model, MODEL_BYTES))
    except OSError:
        ours = False
    if not ours:
        raise InputError(f"{model} exists and is not of an earlier export, or was edited; choose another name.")


def component_names(names: list[str]) -> list[str]:
    """Names that OpenSim accepts for its components: letters, digits and underscores, all different."""
    plain: list[str] = []
    for name in names:
        base = new = "".join(c if c.isascii() and c.isalnum() else "_" for c in name) or "bone"
        count = 1
        while new in plain or new == "ground":
            count += 1
            new = f"{base}_{count}"
        plain.append(new)
    return plain


def _shift(motion: Motion, b: int) -> np.ndarray:
    """How far (T, 3) a head moves from where its parent carries it, along the parent's axes in the rest pose; in the world for roots."""
    rig, a = motion.rig, int(motion.rig.parents[b])
    shift_m = motion.head_m[:, b] - head_of(rig, motion.R, motion.head_m, b)
    if a < 0:
        return shift_m
    return np.einsum("tji,tj->ti", motion.R[:, a] @ rig.R_rest[a].T, shift_m)


def _storage(name: str, columns: dict[str, np.ndarray]) -> str:
    table = np.stack(list(columns.values()), axis=1)
    head = [name, "version=1", f"nRows={len(table)}", f"nColumns={len(columns)}", "inDegrees=yes", "endheader", "\t".join(columns)]
    return "\n".join([*head, *("\t".join(f"{value:.9g}" for value in row) for row in table)]) + "\n"


def _model(name: str, rig: Rig, bodies: list[str], moving: set[int], A: np.ndarray) -> bytes:
    """The model as a document of OpenSim 4."""
    document = ElementTree.Element("OpenSimDocument", Version="40000")
    model = ElementTree.SubElement(document, "Model", name=name)
    _add(model, credits=CREDITS, gravity="0 -9.80665 0")
    _add(model, length_units="meters", force_units="N")
    in_bodies, in_joints = (ElementTree.SubElement(ElementTree.SubElement(model, kind), "objects") for kind in ("BodySet", "JointSet"))
    for b, body in enumerate(bodies):
        a = int(rig.parents[b])
        _add(ElementTree.SubElement(in_bodies, "Body", name=body), mass=MASS_KG, mass_center="0 0 0", inertia=INERTIA)
        place = A @ (rig.head_m[b] - (rig.head_m[a] if a >= 0 else 0.0))
        parent = f"/bodyset/{bodies[a]}" if a >= 0 else "/ground"
        _add_joint(in_joints, body, parent, place, moves=b in moving)
    ElementTree.indent(document)
    return _marked(bytes(ElementTree.tostring(document, encoding="utf-8", xml_declaration=True)))


def _marked(model: bytes) -> bytes:
    """A document with a comment at its end by which a later export recognises that nobody has edited it."""
    return model + f"\n{MARK}{store.digest(model)} -->\n".encode()


def _is_as_written(model: bytes) -> bool:
    return model == _marked(model.rpartition(f"\n{MARK}".encode())[0])


def _add_joint(joints: ElementTree.Element, body: str, parent: str, place: np.ndarray, *, moves: bool) -> None:
    """A joint with three rotations, and three translations if it `moves`; the child's frame is its body's."""
    joint = ElementTree.SubElement(joints, "CustomJoint", name=f"{body}_joint")
    _add(joint, socket_parent_frame=f"{body}_at", socket_child_frame=f"/bodyset/{body}")
    coordinates = ElementTree.SubElement(joint, "coordinates")
    moved = [f"t{axis}" for axis in "xyz"] if moves else []
    for what in (*TURNS, *moved):
        limit = "-99.9 99.9" if what in moved else "-12.5663706 12.5663706"
        _add(ElementTree.SubElement(coordinates, "Coordinate", name=f"{body}_{what}"), default_value="0", range=limit)
    frame = ElementTree.SubElement(ElementTree.SubElement(joint, "frames"), "PhysicalOffsetFrame", name=f"{body}_at")
    _add(frame, socket_parent=parent, translation=" ".join(f"{value:.9g}" for value in place), orientation="0 0 0")
    transform = ElementTree.SubElement(joint, "SpatialTransform")
    for number, what in enumerate(TURNS, 1):
        _add_axis(transform, f"rotation{number}", AXIS[what[1]], f"{body}_{what}")
    for number, axis in enumerate("xyz", 1):
        _add_axis(transform, f"translation{number}", AXIS[axis], f"{body}_t{axis}" if moves else "")


def _add_axis(transform: ElementTree.Element, name: str, axis: str, coordinate: str) -> None:
    part = ElementTree.SubElement(transform, "TransformAxis", name=name)
    _add(part, coordinates=coordinate, axis=axis)
    if coordinate:
        _add(ElementTree.SubElement(part, "LinearFunction", name="function"), coefficients="1 0")
    else:
        _add(ElementTree.SubElement(part, "Constant", name="function"), value="0")


def _add(element: ElementTree.Element, **values: str) -> None:
    for name, text in values.items():
        ElementTree.SubElement(element, name).text = text
