"""What take.toml says of where a view shows the person: a mask, a mask for every image, or an image of the empty background."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import InputError
from .toml_values import inside

PERSON_SOURCES = ("mask", "masks", "background")  # keys of [[views]]; a view has one of them at most


def person_source(entry: Mapping[str, Any], label: str) -> dict[str, str]:
    """The key and the file, or the pattern of files, of a view's table.

    Raises:
        InputError: there are several, or one is no file inside the take.
    """
    said = {key: entry[key] for key in PERSON_SOURCES if key in entry}
    if len(said) > 1:
        raise InputError(f"The {label} has {' and '.join(f'`{key}`' for key in said)}; keep one of them.")
    for key, name in said.items():
        inside(Path(), name, label, key)
    return said
