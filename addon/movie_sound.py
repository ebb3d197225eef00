"""The sound of a movie's own track, read with Blender's `aud`."""

from importlib import import_module
from pathlib import Path

from ..core.foundation import bounded
from ..core.foundation.errors import InputError
from ..core.synchronising.sound import Sound, sound_of
from .blender_module import load_blender


def movie_sound(path: Path) -> Sound | None:
    """The sound of a movie, None if it has no track that can be read.

    Raises:
        InputError: the movie cannot be opened, or its sound is too long.
    """
    load_blender()
    aud = import_module("aud")  # where Blender is a Python module, bpy makes it known
    try:
        bounded.check_file(path, bounded.MOVIE_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read the movie {path}: {error.strerror or error}.") from error
    try:
        sound = aud.Sound(str(path)).rechannel(1)
        rate = sound.specs[0]  # first: in Blender 4.5, data() of a file without sound ends the process
        samples = sound.data()
    except aud.error:
        return None
    return sound_of(samples, round(rate)) if len(samples) else None
