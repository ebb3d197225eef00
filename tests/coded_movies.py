"""Movie files that consist of a time code alone, for tests."""

import struct


def atom(kind: bytes, *content: bytes) -> bytes:
    data = b"".join(content)
    return struct.pack(">I4s", 8 + len(data), kind) + data


def coded_movie(number: int, *, scale: int = 25, duration: int = 1, per_second: int = 25, drop: bool = False, wide: bool = False) -> bytes:
    """An MP4 file of one track, with the time code of its first image: frames since midnight."""
    head = atom(b"ftyp", b"qt  ", bytes(4))
    data = atom(b"mdat", struct.pack(">I", number))
    entry = bytes(6) + struct.pack(">HIIIIBB", 1, 0, int(drop), scale, duration, per_second, 0)
    place = struct.pack(">Q" if wide else ">I", len(head) + 8)
    table = atom(
        b"stbl",
        atom(b"stsd", bytes(4), struct.pack(">I", 1), atom(b"tmcd", entry)),
        atom(b"co64" if wide else b"stco", bytes(4), struct.pack(">I", 1), place),
    )
    handler = atom(b"hdlr", bytes(4), b"mhlr", b"tmcd", bytes(12))
    return head + data + atom(b"moov", atom(b"trak", atom(b"mdia", handler, atom(b"minf", table))))
