"""A process that tries a network, because OpenCV may crash on a damaged one: its content from standard input, an answer of JSON.

A few hundred bytes can ask for any amount of memory and time. Where the system can, the process limits its own to what a network of that
size may need.
"""

import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path

from ..foundation.errors import InputError
from ..networks.pose_network import PoseNetwork

LEAST_BYTES, BYTES_A_CORE, BYTES_A_BYTE = 3 << 28, 16 << 20, 20  # memory, with that of the libraries and of their threads
LEAST_S, SECONDS_A_MB = 3, 1.0  # of the processor, for one run, with the start of the process


def main() -> None:
    """Try the network whose file is named."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print
    data = sys.stdin.buffer.read()
    _limit(len(data))
    try:
        PoseNetwork.of(data, Path(sys.argv[1]))
        answer = {}
    except InputError as error:
        answer = {"error": str(error)}
    answers.write(json.dumps(answer))
    answers.close()


def _limit(size: int) -> None:
    """Limit memory and time of this process by the size [bytes] of the network; Windows has no such limits."""
    if importlib.util.find_spec("resource") is None:
        return
    resource = importlib.import_module("resource")  # mypy knows it on some systems only
    memory = LEAST_BYTES + BYTES_A_CORE * (os.cpu_count() or 1) + BYTES_A_BYTE * size
    seconds = LEAST_S + round(SECONDS_A_MB * size / 1e6)
    for kind, most in ((resource.RLIMIT_DATA, memory), (resource.RLIMIT_CPU, seconds)):
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


if __name__ == "__main__":
    main()
