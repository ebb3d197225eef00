"""One run at a time in a folder of results: a lock that says who holds it, and that a crash cannot leave shut.

The file is locked by the operating system, which lets go of it when a process ends, however it ends; so neither a killed run nor a number
that another process got later can keep anybody out. A file server may not pass such locks from machine to machine: therefore the holder
also counts in the file, and who finds the count of another machine watches whether it goes on. Nobody's clock is asked.
"""

import errno
import json
import os
import platform
import stat
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .errors import InputError

NAME = ".tricap-lock"
BEAT_S, WATCH_S = 1.0, 8.0  # how often the holder counts, how long another machine's count may stand still
COUNT_DIGITS = 12
BYTE = 1 << 30  # the byte that is locked on Windows, beyond the text, which others may read


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which exists; a lock that a killed run left is taken over.

    Raises:
        InputError: another run holds it, or the folder cannot be written to.
    """
    path = Path(folder) / NAME
    try:
        handle = _open(path)
    except OSError as error:
        raise InputError(f"Cannot write into {folder}: {error.strerror or error}. Choose another folder or free some space.") from error
    ended = threading.Event()
    beat = threading.Thread(target=_count, args=(handle, ended), name="tricap lock", daemon=True)
    beat.start()
    try:
        yield
    finally:
        ended.set()
        beat.join()
        _release(path, handle)


def _open(path: Path) -> int:
    """The handle of the lock file, locked and with our name in it."""
    while True:
        handle = _handle(path)
        try:
            system = _lock(handle)
            if not _same_file(path, handle):  # its holder removed it between our opening and locking it
                os.close(handle)
                continue
            _wait_for_a_standing_count(path, own=not system)
            _write(handle, 0)
            return handle
        except BlockingIOError as error:
            os.close(handle)
            raise InputError(_busy(path.parent, _holder(path))) from error
        except BaseException:
            with suppress(OSError):
                os.close(handle)
            raise


def _handle(path: Path) -> int:
    """The lock file opened, never what a link in its place leads to: that would be written over.

    Raises:
        InputError: a link, or no file at all, is in its place.
        OSError: it cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT
    for name in ("O_BINARY", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):  # not every system has each
        flags |= getattr(os, name, 0)
    refused = InputError(f"{path} is a link, or no file; remove it, or choose another folder for the results.")
    if path.is_symlink():  # Windows knows no O_NOFOLLOW
        raise refused
    try:
        handle = os.open(path, flags, 0o644)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise refused from error
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise refused
    return handle


def _lock(handle: int) -> bool:
    """Lock the file here and now; False where the file system knows no locks (there the count decides alone).

    Raises:
        BlockingIOError: another process, or another part of this one, holds it.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(handle, BYTE, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
            raise BlockingIOError(*error.args) from error
        return False
    return True


def _same_file(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(handle))
    except FileNotFoundError:
        return False


def _wait_for_a_standing_count(path: Path, *, own: bool) -> None:
    """Return when nobody on another machine (with `own`: on any) counts in the file.

    Raises:
        InputError: somebody does.
    """
    found = _holder(path)
    if "host" not in found or (found["host"] == platform.node() and not own):
        return  # of this machine the operating system knows better
    until = time.monotonic() + WATCH_S
    while time.monotonic() < until:
        time.sleep(BEAT_S / 2)
        if _holder(path) != found:
            raise InputError(_busy(path.parent, found))


def _holder(path: Path) -> dict[str, Any]:
    """What the file says of its holder; empty where it says nothing that can be understood."""
    try:
        found = json.loads(path.read_bytes()[:1000])
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _busy(folder: Path, holder: dict[str, Any]) -> str:
    who = f" (process {holder['pid']} on {holder['host']})" if {"pid", "host"} <= set(holder) else ""
    return f"Another run{who} writes into {folder} just now; wait until it has ended, or choose another folder for the results."


def _write(handle: int, count: int) -> None:
    text = json.dumps({"pid": os.getpid(), "host": platform.node(), "count": f"{count:0{COUNT_DIGITS}d}"}) + "\n"
    os.lseek(handle, 0, os.SEEK_SET)
    os.write(handle, text.encode())
    os.ftruncate(handle, len(text.encode()))


def _count(handle: int, ended: threading.Event) -> None:
    count = 0
    while not ended.wait(BEAT_S):
        count += 1
        with suppress(OSError):  # a full disk is told by the run itself when it writes a result
            _write(handle, count)


def _release(path: Path, handle: int) -> None:
    """Remove the file while it is still ours; Windows removes no open file, there it goes after it was closed."""
    with suppress(OSError):
        if sys.platform != "win32" and _same_file(path, handle):
            path.unlink()
    os.close(handle)
    if sys.platform == "win32":
        with suppress(OSError):
            path.unlink()
