"""One run at a time in a folder of results: a lock that names its owner and that no crash leaves locked.

The file is locked by the operating system, which releases it when the process ends in any way, so neither a killed run nor a reused process
number blocks others. A file server may not pass such locks between machines: therefore the owner also increments a count in the file, and a
run that finds the count of another machine waits to see whether it increases. No clock is compared.
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

from . import bounded
from .errors import InputError

NAME = ".tricap-lock"
BEAT_S = 1.0  # interval of the owner's count
WATCH_S = 8.0  # after which an unchanged count of another machine is dead
COUNT_DIGITS = 12
BYTE = 1 << 30  # the byte that is locked on Windows, beyond the text, which others must be able to read


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock an existing folder; the lock of a killed run is taken over.

    Raises:
        InputError: another run has locked it, or the folder cannot be written to.
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


def is_ours(folder: Path) -> bool:
    """Whether the run that has locked a folder is this process, or the one that started it."""
    owner = _owner(Path(folder) / NAME)
    return owner.get("host") == platform.node() and owner.get("pid") in (os.getpid(), os.getppid())


def _open(path: Path) -> int:
    """The handle of the lock file, locked, with this process as its owner."""
    while True:
        handle = _handle(path)
        try:
            system = _lock(handle)
            if not _same_file(path, handle):  # its owner removed it between our opening and locking it
                os.close(handle)
                continue
            _wait_for_a_standing_count(path, own=not system)
            _write(handle, 0)
            return handle
        except BlockingIOError as error:
            os.close(handle)
            raise InputError(_busy(path.parent, _owner(path))) from error
        except BaseException:
            with suppress(OSError):
                os.close(handle)
            raise


def _handle(path: Path) -> int:
    """The opened lock file; a link is never followed, and a second name of a file not used, because that would be overwritten.

    Raises:
        InputError: it is a link, or no regular file.
        OSError: it cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT
    for name in ("O_BINARY", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):  # not every system has each
        flags |= getattr(os, name, 0)
    refused = InputError(f"{path} is a link, or no file; remove it, or choose another folder for the results.")
    if path.is_symlink():  # Windows has no O_NOFOLLOW
        raise refused
    try:
        handle = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise refused from error
        raise
    state = os.fstat(handle)
    if not stat.S_ISREG(state.st_mode) or state.st_nlink > 1:  # a second name is a file of somebody's, elsewhere
        os.close(handle)
        raise refused
    return handle


def _lock(handle: int) -> bool:
    """Lock the file without waiting; False if the file system has no locks (then only the count decides).

    Raises:
        BlockingIOError: another process, or another part of this one, has locked it.
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
    """Return when the count of another machine (with `own`: of any) does not increase.

    Raises:
        InputError: it does.
    """
    found = _owner(path)
    if "host" not in found or (found["host"] == platform.node() and not own):
        return  # on this machine the operating system's lock decides
    until = time.monotonic() + WATCH_S
    while time.monotonic() < until:
        time.sleep(BEAT_S / 2)
        if _owner(path) != found:
            raise InputError(_busy(path.parent, found))


def _owner(path: Path) -> dict[str, Any]:
    """The owner in the file; empty if it cannot be parsed."""
    try:
        found = bounded.json_of(bounded.bytes_of(path, bounded.TOML_BYTES)[:1000])
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _busy(folder: Path, owner: dict[str, Any]) -> str:
    who = f" (process {owner['pid']} on {owner['host']})" if {"pid", "host"} <= set(owner) else ""
    return f"Another run{who} is writing into {folder}; wait until it has finished, or choose another folder for the results."


def _write(handle: int, count: int) -> None:
    text = json.dumps({"pid": os.getpid(), "host": platform.node(), "count": f"{count:0{COUNT_DIGITS}d}"}) + "\n"
    os.lseek(handle, 0, os.SEEK_SET)
    os.write(handle, text.encode())
    os.ftruncate(handle, len(text.encode()))


def _count(handle: int, ended: threading.Event) -> None:
    count = 0
    while not ended.wait(BEAT_S):
        count += 1
        with suppress(OSError):  # the run itself reports a full disk when it writes a result
            _write(handle, count)


def _release(path: Path, handle: int) -> None:
    """Remove the file while it is still ours; on Windows after it is closed, because an open file cannot be removed."""
    with suppress(OSError):
        if sys.platform != "win32" and _same_file(path, handle):
            path.unlink()
    os.close(handle)
    if sys.platform == "win32":
        with suppress(OSError):
            path.unlink()
