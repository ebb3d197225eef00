"""The top-level entries of OpenCV's FileStorage, YAML or XML: matrices, numbers, texts and lists of texts.

Read by ourselves: OpenCV's own parser writes beyond its memory on damaged files (both 4 and 5, found by tests/test_fuzz.py).
"""

import re
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from ...errors import InputError
from .reading import numbers, text_of

KEY = re.compile(r'("[^"]*"|[^\s:#"-][^:]*?)\s*:(?:\s+(.*))?$')
NAMES = re.compile(r'"([^"]*)"|([^\s",]+)')
MOST_LINES, LARGEST_MATRIX = 200_000, 10_000
Entry = np.ndarray | float | str | list[str]


class Nodes:
    """The entries of a file, by name.

    Raises:
        InputError: it is no FileStorage.
    """

    def __init__(self, path: Path) -> None:
        text = text_of(path)
        self._path = path
        self._entries = _of_xml(text, path) if text.lstrip("\ufeff \r\n\t").startswith("<") else _of_yaml(text, path)
        if not self._entries:
            raise InputError(f"{path} is no YAML or XML that OpenCV can read; write it with cv2.FileStorage.")

    def has(self, key: str) -> bool:
        """Whether there is such an entry."""
        return key in self._entries

    def matrix(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """An entry that is a matrix.

        Raises:
            InputError: it is missing or has another shape.
        """
        value = self._entries.get(key)
        if not isinstance(value, np.ndarray):
            raise InputError(f"{self._path} lacks the matrix “{key}”; it is no complete calibration.")
        return numbers(value, shape, f"“{key}” in {self._path}")

    def number(self, *keys: str) -> float | None:
        """The first of some entries that is a number."""
        return next((value for key in keys if isinstance(value := self._entries.get(key), float)), None)

    def names(self) -> list[str]:
        """The sequence of texts `names`."""
        value = self._entries.get("names")
        return [str(value)] if isinstance(value, (str, float)) else value if isinstance(value, list) else []


def _of_yaml(text: str, path: Path) -> dict[str, Entry]:
    """Blocks begin with “key:” at the margin; what is indented, or begins with “-”, belongs to the block before."""
    blocks: dict[str, list[str]] = {}
    lines = text.splitlines()
    if len(lines) > MOST_LINES:
        raise InputError(f"{path} has more lines than a calibration has.")
    for line in lines:
        found = KEY.match(line) if line[:1] not in (" ", "\t", "-", "%", "#", ".") else None
        if found:
            name = found.group(1).strip('"')
            blocks[name] = [found.group(2) or ""]
        elif blocks and line.strip() and not line.startswith(("%", "---", "...", "#")):
            blocks[name].append(line.strip())
    return {name: _yaml_entry(name, block, path) for name, block in blocks.items()}


def _yaml_entry(name: str, block: list[str], path: Path) -> Entry:
    whole = " ".join(block)
    if whole.startswith("!!opencv-matrix"):
        data = re.search(r"data:\s*\[([^\]]*)\]", whole)
        counts = [re.search(rf"\b{word}:\s*(\d{{1,9}})\b", whole) for word in ("rows", "cols")]
        if data is None or not all(counts):
            raise InputError(f"The matrix “{name}” in {path} is damaged; write it with cv2.FileStorage.")
        return _matrix(name, data.group(1).replace(",", " "), [int(c.group(1)) for c in counts if c], path)
    if len(block) > 1 and not block[0] and block[1].startswith("-"):
        return [item.lstrip("- ").strip().strip('"') for item in block[1:]]
    if whole.strip().startswith("["):
        return [a or b for a, b in NAMES.findall(whole.strip().strip("[]"))]
    return _scalar(whole)


def _of_xml(text: str, path: Path) -> dict[str, Entry]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} defines entities, which a calibration does not need; write it with cv2.FileStorage.")
    try:
        root = Xml.fromstring(text)
    except (Xml.ParseError, ValueError) as error:
        raise InputError(f"{path} is not an XML file: {error}.") from error
    found: dict[str, Entry] = {}
    for element in root:
        if element.get("type_id") == "opencv-matrix":
            rows, cols = (element.findtext(word, "").strip() for word in ("rows", "cols"))
            if not (rows.isdecimal() and cols.isdecimal() and len(rows + cols) < 16):
                raise InputError(f"The matrix “{element.tag}” in {path} is damaged; write it with cv2.FileStorage.")
            found[element.tag] = _matrix(element.tag, element.findtext("data", ""), [int(rows), int(cols)], path)
        else:
            words = [a or b for a, b in NAMES.findall(element.text or "")]
            found[element.tag] = words if element.tag == "names" or len(words) > 1 else _scalar(" ".join(words))
    return found


def _matrix(name: str, text: str, shape: list[int], path: Path) -> np.ndarray:
    words = text.split()
    if len(words) > LARGEST_MATRIX or len(words) != shape[0] * shape[1]:
        raise InputError(f"The matrix “{name}” in {path} is {shape[0]}×{shape[1]}, but has {len(words)} numbers; the file is damaged.")
    return numbers(words, (shape[0], shape[1]), f"“{name}” in {path}")


def _scalar(text: str) -> Entry:
    word = text.split(" #")[0].strip()
    try:
        return float(word)
    except ValueError:
        return word.strip('"')
