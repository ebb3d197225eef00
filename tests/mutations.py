"""Damaged copies of files, and the child process that reads them: the engine of test_fuzz.py.

    python tests/mutations.py FOLDER COUNT [NAME…]      COUNT damaged copies for each reader; one line of JSON each on standard output

A copy is damaged as transfers, disks and strangers do it: cut, with bytes changed, numbers too large or not finite, values of another kind,
nested too deeply, with endless lines, in another encoding or spelling, packed, empty. Never larger than a megabyte. In place of every file
there is then something that is no file, or far too large: SPECIAL; and the sound files are read in folders with the names of FOLDER_NAMES.
"""

import gzip
import io
import json
import os
import random
import re
import shutil
import signal
import socket
import struct
import sys
import time
import traceback
import zipfile
import zlib
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

LARGEST = 1_000_000
SECONDS, MEGABYTES = 2.0, 500.0
WAITS_S = 8  # after which a reader is stopped that waits instead of working
ADDRESSES = 6 << 30  # bytes that the process may have: more would take the machine's memory
NUMBERS = (b"1e308", b"-1e308", b"nan", b"inf", b"-inf", b"-1", b"0", b"99999999999999999999", b"2147483648", b"4294967295", b"1e-320",
           b"65536", b"0x10", b"1_0", b"9" * 5000, b"9" * 400, b"-" + b"9" * 400, b"0x" + b"f" * 10_000, b"0b" + b"1" * 10_000,
           b"1" * 300 + b".0", b"0." + b"3" * 10_000, b"1e" + b"9" * 400, b"-nan", b"1e309")  # fmt: skip
KINDS = (b'"text"', b"[]", b"{}", b"[[1, 2], [3]]", b"null", b"true", b"''", b"-", b"1979-05-27", b"[" * 60, b"&a;", b"%n")
WORDS = (struct.pack("<I", 0xFFFFFFFF), struct.pack("<I", 0x7FFFFFFF), struct.pack("<I", 0x10000000), struct.pack("<H", 0xFFFF),
         struct.pack("<f", float("nan")), struct.pack("<f", 1e38), struct.pack("<d", float("inf")), struct.pack("<d", float("nan")),
         struct.pack("<d", 1e308), struct.pack(">I", 0x00FFFFFF),
         b"\0" * 8, struct.pack("<I", 1 << 24))  # fmt: skip
TEXTS = (b'"\\u0000"', b'"../x"', b'"/"', b'"."', b'""', b'"\\u001b[31m"', b'"a/b.toml"')
KEYS = (b"movie", b"images", b"mask", b"masks", b"background", b"timestamps", b"fps", b"start", b"affinity", b"distortions", b"fisheye",
        b"kind", b"frame", b"frames", b"model", b"sigma", b"name", b"view", b"xy", b"polygon", b"joints", b"surface")  # fmt: skip
NODES: tuple[Any, ...] = (None, True, "", "9" * 5000, "\u00b2", "1e999", -1, 2**80, 1e308, -0.5, [], {}, [[1], 2], {"a": []}, ["x"] * 3000)
NEST = (b"[", b'{"a":', b"<a>", b"((", b"a = [[", b"{ ", b"- ", b"a.", b"{a=", b"data: [", b"JOINT a {", b"[[a.", b'"\\u0041".')
TOWERS = ((b"[", b"]"), (b'{"a":', b"}"), (b"<a>", b"</a>"), (b"data: [", b"]"), (b"{a=", b"}"), (b"{a: ", b"}"), (b"a.", b""),
          (b"- ", b""), (b" ", b""), (b"a: ", b""), (b"? ", b""), (b"&a [", b"]"), (b"!!a ", b""), (b"(", b")"),
          (b"JOINT a\n{\nOFFSET 0 1 0\n", b"}\n"), (b"<!-- ", b" -->"), (b"\n[a]\n[a.a]\n", b""), (b"[[a]]\n", b""))  # fmt: skip
FOLDER_NAMES = (os.fsdecode(b"not \xff utf-8"), "two\nlines", "\u00e9 \u4eba \U0001f600", "%n%s $(x) ;`x`", "-o", "=1+1", "x" * 200)
SPARSE_BYTES = 20_000_000_000


def mutate(data: bytes, r: random.Random) -> bytes:
    """A damaged copy."""
    for _ in range(r.choice((1, 1, 1, 2, 4))):
        data = r.choice(DAMAGES)(data, r)
    return data[:LARGEST]


def _place(data: bytes, r: random.Random) -> int:
    """Anywhere, but often in the head, where the counts stand."""
    return r.randrange(min(len(data), r.choice((64, 400, len(data) or 1))) or 1)


def _cut(data: bytes, r: random.Random) -> bytes:
    return data[: _place(data, r)] if r.random() < 0.7 else data[_place(data, r) :]


def _flip(data: bytes, r: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(r.choice((1, 1, 3, 20))):
        changed[_place(changed, r)] = r.randrange(256)
    return bytes(changed)


def _word(data: bytes, r: random.Random) -> bytes:
    i, word = _place(data, r), r.choice(WORDS)
    i -= i % r.choice((1, 2, 4))
    return data[:i] + word + data[i + len(word) :]


def _value(data: bytes, r: random.Random) -> bytes:
    """A number becomes another number, or something else."""
    found = list(re.finditer(rb"-?\d+\.?\d*(e[-+]?\d+)?", data[:200_000]))
    if not found:
        return _flip(data, r)
    m = r.choice(found[: r.choice((8, 40, len(found)))])
    return data[: m.start()] + r.choice(NUMBERS if r.random() < 0.7 else KINDS) + data[m.end() :]


def _name(data: bytes, r: random.Random) -> bytes:
    """A word becomes another one of the file."""
    found = list(re.finditer(rb"[A-Za-z_]{2,}", data[:200_000]))
    if not found:
        return _word(data, r)
    m, n = r.choice(found), r.choice(found)
    return data[: m.start()] + (n.group() if r.random() < 0.7 else b"constructor\xc3\xa9") + data[m.end() :]


def _text(data: bytes, r: random.Random) -> bytes:
    """A quoted text becomes another one, or something else."""
    found = list(re.finditer(rb'"[^"\n]*"', data[:200_000]))
    if not found:
        return _name(data, r)
    m = r.choice(found)
    return data[: m.start()] + r.choice(TEXTS + KINDS + NUMBERS) + data[m.end() :]


def _key(data: bytes, r: random.Random) -> bytes:
    """One more line of TOML, with a key that files have, and any value."""
    lines = data.split(b"\n")
    lines.insert(r.randrange(len(lines)) + 1, r.choice(KEYS) + b" = " + r.choice(TEXTS + KINDS + NUMBERS + (b"[1]", b"[-1.0, 0.0]")))
    return b"\n".join(lines)


def _lines(data: bytes, r: random.Random) -> bytes:
    lines = data.split(b"\n")
    i, j = r.randrange(len(lines)), r.randrange(len(lines))
    what = r.randrange(4)
    if what == 0:
        del lines[i]
    elif what == 1:
        lines[i:i] = [lines[j]] * r.choice((1, 3, 2000))
    elif what == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines[i] = lines[i] * r.choice((2, 500))
    return b"\n".join(lines)


def _node(data: bytes, r: random.Random) -> bytes:
    """A value of a JSON file becomes one of another kind, or has one, whatever it is that stands there."""
    try:
        table = json.loads(data)
    except (ValueError, RecursionError):
        return _value(data, r)
    places: list[tuple[Any, Any]] = []
    waiting = [table]
    while waiting and len(places) < 5000:
        value = waiting.pop()
        inside = list(value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ())
        places += [(value, key) for key, _ in inside]
        waiting += [v for _, v in inside]
    if not places:
        return _value(data, r)
    holder, key = r.choice(places[: r.choice((10, len(places)))])
    holder[key] = r.choice(NODES)
    return json.dumps(table).encode()


def _again(data: bytes, r: random.Random) -> bytes:
    """A list of a JSON file has its values again and again, as often as they fit."""
    try:
        table = json.loads(data)
    except (ValueError, RecursionError):
        return _lines(data, r)
    lists: list[list[Any]] = []
    waiting = [table]
    while waiting and len(lists) < 5000:
        value = waiting.pop()
        lists += [value] if isinstance(value, list) and value else []
        waiting += list(value.values() if isinstance(value, dict) else value if isinstance(value, list) else ())
    if not lists:
        return _lines(data, r)
    longer = r.choice(lists)
    longer *= r.choice((2, 300, max(1, (LARGEST - len(data)) // (len(json.dumps(longer)) + 2))))
    return json.dumps(table).encode()


def _all_different(data: bytes, r: random.Random) -> bytes:
    """Many rows like one of a table, each with numbers and names of its own: as many columns as rows, for who makes a table of them."""
    lines = data.split(b"\n")
    i, many = r.randrange(len(lines)), r.choice((300, 30_000))

    def renamed(k: int) -> bytes:
        numbered = re.sub(rb"\b\d+\b", b"%d" % k, lines[i], count=r.choice((1, 2)))
        return re.sub(rb"[A-Za-z][A-Za-z_.]*", lambda m: m.group() + b"%d" % k, numbered, count=1)

    return b"\n".join([*lines[:i], *(renamed(k) for k in range(min(many, LARGEST // (len(lines[i]) + 8)))), *lines[i:]])


def _insert(data: bytes, r: random.Random) -> bytes:
    i = _place(data, r)
    deep, long = r.choice((20, 600, 100_000)), r.choice((1000, 300_000))
    endless = r.choice((b"9", b"a", b" ", b"\xff", b"\0", b"0,", b"\t")) * long
    what = r.choice((r.choice(NEST) * deep, endless, b"\xff\xfe", b"\0", b"\xed\xa0\x80", b"\r", "é\uffff".encode()))
    return data[:i] + what + data[i:]


def _deep(data: bytes, r: random.Random) -> bytes:
    """Brackets, keys or elements inside of each other: a file of its own, a line, or a value; often they are closed again."""
    opening, closing = r.choice(TOWERS)
    floors = r.choice((3_000, 20_000))
    tower = opening * floors + r.choice((b"", b"1", b"a = 1\n", b"1" + closing * floors, b"]\na = 1\n"))
    places = [m.end() for m in re.finditer(rb"[=:,>\n\[] ?", data[:200_000])]
    i = r.choice((0, len(data), *r.sample(places, min(len(places), 4))))
    return data[:i] + r.choice((b"", b"", b"[", b"x = ")) + tower + r.choice((b"", data[i:], b"\n" + data[i:]))


def _indented(data: bytes, r: random.Random) -> bytes:
    """Each line a step deeper than the one before, as YAML nests."""
    key, i = r.choice((b"a:", b"-", b"a: &b", b"- a:")), r.choice((0, _place(data, r)))
    return data[:i] + b"\n" + b"".join(b" " * k + key + b"\n" for k in range(r.choice((100, 1300)))) + data[i:]


def _encoded(data: bytes, r: random.Random) -> bytes:
    """Text in another encoding, with or without the mark at its beginning; or in a word of it, what is not text in UTF-8."""
    if r.random() < 0.5:
        kind = r.choice(("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "utf-7", "cp037"))
        return data.decode("latin-1").encode(kind, errors="replace")
    words = list(re.finditer(rb"[A-Za-z_]{2,}", data[:200_000]))
    i = r.choice(words).start() + 1 if words else _place(data, r)
    what = r.choice(
        (b"\xe9", b"\0", b"\xc0\x80", b"\xed\xa0\x80", b"\xf4\x90\x80\x80", "\u202e".encode(), "\ufeff".encode(), b"\x1b[2J", b"\x85")
    )
    return data[:i] + what + data[i:]


def _spelled(data: bytes, r: random.Random) -> bytes:
    """Text as other countries and programs write it: decimal commas, digits of other scripts, formulas, quotes, other ends of lines."""
    what = r.randrange(5)
    if what == 0:
        return re.sub(rb"(\d)\.(\d)", rb"\1,\2", data)
    if what == 1:
        digits = r.choice(("\u0660", "\u0966", "\uff10", "\U0001d7ce"))  # zeros of scripts whose digits Python's int reads, too
        place = _place(data, r)
        return data[:place] + re.sub(rb"\d", lambda m: chr(ord(digits) + int(m.group())).encode(), data[place:], count=r.choice((1, 9999)))
    if what == 2:
        begin = r.choice((b"=", b"+", b"-", b"@", b"\t=", b'"=', b"=HYPERLINK(", b"'"))
        return re.sub(rb"(^|,|\n)([A-Za-z])", rb"\g<1>" + begin + rb"\g<2>", data, count=r.choice((1, 9999)))
    if what == 3:
        return re.sub(rb"(^|[,\n])([^,\n]*)", rb'\1"\2"', data, count=r.choice((1, 9999)))
    return data.replace(b"\n", r.choice((b"\r", b"\r\n", b"\n\r", b"\x0b", b"\x0c", "\u2028".encode(), b"\x85", b"\0")))


def _packed(data: bytes, r: random.Random) -> bytes:
    """The file in an archive, in another file's clothes, or twice."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(r.choice(("header_json.npy", "../a", "a" * 300, "\u202e")), data)
    heads = (
        b"%PDF-1.7\n",
        b"\x89PNG\r\n\x1a\n",
        b"BLENDER",
        b"glTF\x02\0\0\0",
        b"ply\nformat ascii 1.0\n",
        b"RIFF",
        b"#!/bin/sh\n",
        b"<?xml?>",
    )
    return r.choice((gzip.compress(data, mtime=0), archive.getvalue(), r.choice(heads) + data, data + data, data[::-1]))


def _nothing(data: bytes, r: random.Random) -> bytes:
    return r.choice((b"", b"\n", b"\0" * 100, b"\xef\xbb\xbf" + data, data.decode("latin-1").encode("utf-16")))


def _sound_sums(data: bytes, r: random.Random) -> bytes:
    """A damaged PNG whose check sums are right, so that the decoder does not stop at once."""
    if not data.startswith(b"\x89PNG") or len(data) < 33:
        return _word(data, r)
    head = bytearray(data[12:29])
    i = r.choice((4, 8, 12, 13, 16))
    head[i : i + 4] = r.choice(WORDS)[:4] if i < 12 else bytes([r.randrange(20)])
    head = head[:17]
    return data[:12] + bytes(head) + struct.pack(">I", zlib.crc32(head)) + data[33:]


DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _cut, _flip, _flip, _word, _word, _value, _value, _value, _text, _text, _key, _key, _name, _lines, _node, _node, _again, _all_different,
    _insert, _deep, _deep,
    _indented, _encoded, _spelled, _spelled, _packed, _nothing, _sound_sums)  # fmt: skip


def memory_mb() -> tuple[float, float]:
    """Resident memory of this process now, and the most it ever had; zeros where the system does not say."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0.0, 0.0
    sizes = {line.split(":")[0]: float(line.split()[1]) / 1024 for line in lines if line.startswith(("VmRSS", "VmHWM"))}
    return sizes["VmRSS"], sizes["VmHWM"]


def forget_the_most() -> None:
    """The most memory is counted anew from here (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError as error:
        sys.stderr.write(f"Memory is not counted anew: {error}\n")


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def _sparse(path: Path) -> None:
    """A file of 20 GB that takes no room on the disk; it begins like the sound one."""
    with path.open("wb") as file:
        file.truncate(SPARSE_BYTES)


def _endpoint(path: Path) -> None:
    os.chdir(path.parent)  # the name of a socket is at most 100 bytes long
    with socket.socket(socket.AF_UNIX) as endpoint:
        endpoint.bind(path.name)


SPECIAL: dict[str, Callable[[Path], None]] = {
    "a pipe": _pipe,
    "an endless device": _link_to("/dev/zero"),
    "a terminal": _link_to("/dev/tty"),
    "a file of 20 GB": _sparse,
    "a folder": Path.mkdir,
    "a socket": _endpoint,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to the kernel's memory": _link_to("/proc/self/mem"),
}
if os.name == "nt":
    SPECIAL = {name: SPECIAL[name] for name in ("a file of 20 GB", "a folder")}


class Waits(BaseException):
    """Nobody catches it: no reader takes it for an error of the file."""


def _out_of_time(signum: int, frame: Any) -> None:
    raise Waits(f"it has waited for {WAITS_S} s")


def tried(read: Callable[[Path], Any], folder: Path) -> tuple[bool, str, float, float]:
    """One call of a reader: whether it refused the file, its fault or "", and the seconds of work and megabytes that it took."""
    from readers import InputError

    forget_the_most()
    refused, fault, before, began = False, "", memory_mb()[0], time.process_time()
    if os.name != "nt":
        signal.signal(signal.SIGALRM, _out_of_time)
        signal.alarm(WAITS_S)
    try:
        read(folder)
    except InputError as error:
        refused = True
        if len(str(error)) > 2000 or not str(error).isprintable():
            fault = f"an unreadable sentence of {len(str(error))} characters: {str(error)[:200]!r}"
    except BaseException:
        fault = traceback.format_exc(limit=-4)
    finally:
        if os.name != "nt":
            signal.alarm(0)
    seconds, most = time.process_time() - began, memory_mb()[1] - before
    if seconds > SECONDS or most > MEGABYTES:
        fault = fault or f"{seconds:.1f} s of work, {most:.0f} MB"
    return refused, fault, seconds, most


def attack(name: str, folder: Path, count: int) -> dict[str, Any]:
    """Damage a reader's files `count` times, put each of SPECIAL in place of each, and read them in a folder with each of FOLDER_NAMES;
    what came of it. The faults carry the damaged file's number, what was in its place, or the name."""
    from readers import FAULTY, READERS

    make, read = (READERS | FAULTY)[name]
    files = make(folder)
    whole = {path: path.read_bytes() for path in files}
    read(folder)
    there = sorted(folder.rglob("*"))
    said = {"reader": name, "read": 0, "refused": 0, "special": 0, "names": 0, "slowest_s": 0.0, "most_mb": 0.0, "faults": []}
    for number in range(count):
        r = random.Random(f"{name} {number}")
        target = r.choice(files)
        for path in files:
            path.write_bytes(mutate(whole[path], r) if path == target else whole[path])
        refused, fault, seconds, most = tried(read, folder)
        said["refused" if refused else "read"] += 1
        said["slowest_s"], said["most_mb"] = max(said["slowest_s"], seconds), max(said["most_mb"], most)
        if fault:
            said["faults"].append({"number": number, "file": target.name, "fault": fault})
    for path in files:
        path.write_bytes(whole[path])
    for target, (what, put) in product(files if name in READERS else (), SPECIAL.items()):
        target.unlink()
        put(target)
        _, fault, _, _ = tried(read, folder)
        said["special"] += 1
        if fault:
            said["faults"].append({"number": what, "file": target.name, "fault": fault})
        target.rmdir() if target.is_dir() and not target.is_symlink() else target.unlink(missing_ok=True)
        target.write_bytes(whole[target])
    for other in FOLDER_NAMES if name in READERS and sys.platform == "linux" else ():
        _, fault, _, _ = tried(read, Path(shutil.copytree(folder, folder / other, ignore=shutil.ignore_patterns(other))))
        shutil.rmtree(folder / other)
        said["names"] += 1
        if fault:
            said["faults"].append({"number": ascii(other), "file": "", "fault": fault})
    if sorted(folder.rglob("*")) != there:
        said["faults"].append({"number": "all", "file": "", "fault": "files were made or removed by who only reads"})
    return said


def main() -> None:
    """Attack the readers named, or all."""
    sys.path.insert(0, str(Path(__file__).parent))
    import readers

    if os.name != "nt":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, ADDRESSES))
    folder, count = Path(sys.argv[1]).absolute(), int(sys.argv[2])
    for name in sys.argv[3:] or readers.READERS:
        own = folder / name.replace(".", "_")
        own.mkdir(parents=True, exist_ok=True)
        sys.stderr.write(f"@{name}\n")
        sys.stderr.flush()
        sys.stdout.write(json.dumps(attack(name, own, count)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
