"""A process in which a network runs, because OpenCV may crash on a damaged one, and because what a network needs may depend on the image:
the size and the content of the file and then one input after another from standard input, a line of JSON for each of them.

A few hundred bytes can ask for any amount of memory and time. Where the system can, the process limits its own to what a network of that
size may need.
"""

import importlib
import importlib.util
import json
import math
import os
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation.errors import InputError
from ..networks.pose_network import PoseNetwork

LEAST_BYTES, BYTES_A_CORE, BYTES_A_BYTE = 3 << 28, 16 << 20, 20  # memory, with that of the libraries and of their threads
LEAST_S, SECONDS_A_MB = 2, 1.0  # of the processor, for one run
LENGTH = struct.Struct("<Q")  # of the file, before its content


def main() -> None:
    """Open the network whose file is named, and run it for every input until there are no more, or it fails."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print
    given = sys.stdin.buffer
    (size,) = LENGTH.unpack(given.read(LENGTH.size))
    data = given.read(size)
    allow = _limit(size)

    def answer(found: dict[str, Any]) -> None:
        answers.write(json.dumps(found) + "\n")
        answers.flush()

    try:
        allow()
        network = PoseNetwork.of(data, Path(sys.argv[1]))
        answer(network.description())
        length = 4 * math.prod(network.input_shape)
        while len(blob := given.read(length)) == length:
            allow()
            answer({"points": network.points(np.frombuffer(blob, dtype="<f4").reshape(network.input_shape)).tolist()})
    except InputError as error:
        answer({"error": str(error)})


def _limit(size: int) -> Callable[[], None]:
    """Limit the memory of this process by the size [bytes] of the network; what is returned allows it the time of one more run. Windows has
    no such limits."""
    if importlib.util.find_spec("resource") is None:
        return lambda: None
    resource = importlib.import_module("resource")  # mypy knows it on some systems only

    def limit(kind: int, most: int) -> None:
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))

    def allow() -> None:
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime) + LEAST_S + round(SECONDS_A_MB * size / 1e6))

    limit(resource.RLIMIT_DATA, LEAST_BYTES + BYTES_A_CORE * (os.cpu_count() or 1) + BYTES_A_BYTE * size)
    return allow


if __name__ == "__main__":
    main()
