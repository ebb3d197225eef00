"""FBX: what Blender's importer would make of a binary file, counted before it does. The file itself is read by Blender.

The importer trusts what a file says of itself: it makes a list for as many values as a record claims to have, and unpacks arrays of any
length, so that 900 kB can become 2 GB. It also follows the connections between objects (curve → layer → stack, shape → channel → mesh) on
every path, of which a few thousand connections can make millions. Layout of the records: A. Gessler, "FBX binary file format
specification", Blender developers' blog (2013); from version 7500 on, with words of 64 bits.
"""

import struct
import zlib
from collections import Counter
from pathlib import Path
from typing import BinaryIO

from ...foundation import bounded
from ...foundation.errors import InputError, damage_of

MAGIC = b"Kaydara FBX Binary  \0\x1a\0"
WIDE_FROM = 7500  # the version from which words have 64 bits
SINGLE = {"Z": 1, "Y": 2, "B": 1, "C": 1, "I": 4, "F": 4, "D": 8}  # bytes of a value, by its kind
ARRAYS = {"b": 1, "c": 1, "i": 4, "l": 8, "f": 4, "d": 8}  # bytes of an element
TEXTS = "RS"
DEEPEST = 64  # records in each other
MOST_OBJECTS = 5_000  # models, meshes, materials, …: whatever becomes a thing of Blender's
MOST_OF_A_KIND = 1_000  # other than models; beyond, Blender searches for a free name for seconds
MODEL = "Model"
MANY = ("AnimationCurve", "AnimationCurveNode", "Deformer", "NodeAttribute")  # are parts of others
MOST_PATHS, STEPS = 1_000_000, 4  # along so many connections
LAYER = "AnimationLayer"
MOST_UNPACKED = 100_000_000  # bytes
MOST_RATIO = 100  # times its size, for larger files
PIECE = 1 << 20
PICTURES = {("Texture", "FileName"), ("Texture", "RelativeFilename"), ("Video", "Filename"), ("Video", "RelativeFilename")}
LONGEST_NAME = 4096


def check_fbx(path: Path) -> None:
    """Check that a file does not ask for far more than it contains, nor names what is no file as a picture, such as a pipe, for which the
    importer would wait. One that is not binary is left to Blender, which refuses it.

    Raises:
        InputError: it does, or is damaged.
    """
    try:
        with bounded.opened(path, bounded.ARRAYS_BYTES) as file:
            start = file.read(len(MAGIC))
            if not start:
                raise ValueError("it is empty")
            if start == MAGIC:
                walk = _Walk(file, path)
                walk.all()
                for name in walk.pictures:
                    _check_picture(path.parent, name)
                if max(_paths(walk.joined), _actions(walk.joined, walk.layers)) > MOST_PATHS:
                    raise InputError(f"{path} connects its objects in more than {MOST_PATHS} ways; export the rig alone.")
    except (OSError, ValueError, struct.error, zlib.error, RecursionError) as error:
        raise InputError(f"{path} is not an FBX file that can be read ({damage_of(error)}); it is damaged, export it again.") from error


class _Walk:
    """One passage through the records of a file, with what was counted so far."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        self._size = path.stat().st_size
        self._unpacked = self._objects = 0
        self._kinds = Counter[str]()
        self.joined: list[tuple[int, int]] = []  # the objects that are connected, by their numbers: child and parent
        self.layers: set[int] = set()  # the numbers of the animation's layers
        self.pictures: set[str] = set()  # the names of their files

    def all(self) -> None:
        """Every record of the file."""
        (version,) = self._read("<I")
        self._head = "<QQQB" if version >= WIDE_FROM else "<IIIB"
        while self._record(self._size, 0, ""):
            pass

    def _read(self, layout: str) -> tuple[int, ...]:
        return struct.unpack(layout, self._file.read(struct.calcsize(layout)))

    def _record(self, room_to: int, depth: int, parent: str) -> bool:
        """One record and those in it; whether there was one."""
        end, values, _, length = self._read(self._head)
        if end == 0:
            return False
        name = self._file.read(length).decode("latin-1")
        if depth > DEEPEST or end > room_to or values > end - self._file.tell():
            raise ValueError("a record that does not fit into the file")
        if parent == "Objects" and name not in MANY:
            self._count(name)
        named = (parent, name) in PICTURES
        numbers = [found for _ in range(values) if (found := self._value(end, named)) is not None]
        if parent == "Connections" and len(numbers) > 1:
            self.joined.append((numbers[0], numbers[1]))
        if name == LAYER:
            self.layers.update(numbers[:1])
        while self._file.tell() < end and self._record(end, depth + 1, name):
            pass
        if self._file.tell() != end:
            raise ValueError("a record that does not end where it claims to")
        return True

    def _count(self, kind: str) -> None:
        self._objects += 1
        self._kinds[kind] += kind != MODEL
        if self._objects > MOST_OBJECTS:
            raise InputError(f"{self._path} has more than {MOST_OBJECTS} objects; export the rig alone.")
        if self._kinds[kind] > MOST_OF_A_KIND:
            raise InputError(f"{self._path} has more than {MOST_OF_A_KIND} objects of the kind “{kind[:40]}”; export the rig alone.")

    def _value(self, end: int, named: bool) -> int | None:
        """Pass a value; returns it if it is a number of an object. `named`: texts are names of pictures."""
        kind = self._file.read(1).decode("latin-1")
        if kind in ARRAYS:
            count, packed, length = self._read("<III")
            self._fits(length, end)
            self._array(count * ARRAYS[kind], self._file.read(length), packed == 1)
        elif kind and kind in TEXTS:
            (length,) = self._read("<I")
            self._fits(length, end)
            if named and length <= LONGEST_NAME:
                self.pictures.add(self._file.read(length).decode(errors="replace"))
            else:
                self._file.seek(length, 1)
        elif kind == "L":
            return self._read("<q")[0]
        elif kind in SINGLE:
            self._file.seek(SINGLE[kind], 1)
        else:
            raise ValueError("a value of an unknown kind")
        return None

    def _fits(self, length: int, end: int) -> None:
        if self._file.tell() + length > end:
            raise ValueError("a value that does not fit into its record")

    def _array(self, claimed: int, data: bytes, packed: bool) -> None:
        """Count the bytes of an array: what it claims, and what it unpacks to, which need not be the same."""
        self._unpacked += claimed
        if self._unpacked > max(MOST_UNPACKED, MOST_RATIO * self._size):
            raise InputError(f"{self._path} would unpack to more than {self._unpacked / 1e9:.1f} GB; it is damaged, export it again.")
        found = _unpacked_size(data, claimed) if packed else len(data)
        if found != claimed:
            raise ValueError("an array whose length is not as it claims")


def _check_picture(folder: Path, name: str) -> None:
    """A picture may lie anywhere, as on the machine that wrote the file, but what is there must be a file.

    Raises:
        OSError: it is something else.
    """
    plain = name.replace("\\", "/").replace("\0", "")
    for place in (Path(plain), folder / plain, folder / plain.lstrip("/"), folder / Path(plain).name):
        if place.name and place.exists() and not place.is_dir():
            bounded.check_file(place, bounded.ARRAYS_BYTES)


def _actions(joined: list[tuple[int, int]], layers: set[int]) -> int:
    """How often an object would be animated: in every stack, by every layer of it, by every curve of that that is also connected to it."""
    parents: dict[int, list[int]] = {}
    for child, parent in joined:
        parents.setdefault(child, []).append(parent)
    total = 0
    for above in parents.values():
        stacks = [len(parents.get(parent, [])) for parent in above if parent in layers]
        total += sum(stacks) * (len(above) - len(stacks))
    return total


def _paths(joined: list[tuple[int, int]]) -> int:
    """The number of paths from child to parent along STEPS connections or fewer, counted to a little more than MOST_PATHS in each step."""
    parents: dict[int, list[int]] = {}
    for child, parent in joined:
        parents.setdefault(child, []).append(parent)
    total, ways = 0, dict.fromkeys(parents, 1)  # that begin with an object
    for _ in range(STEPS):
        ways = {child: min(sum(ways.get(parent, 1) for parent in above), 2 * MOST_PATHS) for child, above in parents.items()}
        total = max(total, sum(ways.values()))
    return total


def _unpacked_size(data: bytes, most: int) -> int:
    """The bytes to which zlib data unpack, counted up to a little more than `most`; they are not kept."""
    unpacker, total = zlib.decompressobj(), 0
    while total <= most and not unpacker.eof:
        piece = unpacker.decompress(data, PIECE)
        if not piece:
            break
        data, total = unpacker.unconsumed_tail, total + len(piece)
    return total
