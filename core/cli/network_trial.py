"""A process that tries a network, because OpenCV may crash on a damaged one: its content from standard input, an answer of JSON."""

import json
import os
import sys
from pathlib import Path

from ..foundation.errors import InputError
from ..networks.pose_network import PoseNetwork


def main() -> None:
    """Try the network whose file is named."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print
    try:
        PoseNetwork.of(sys.stdin.buffer.read(), Path(sys.argv[1]))
        answer = {}
    except InputError as error:
        answer = {"error": str(error)}
    answers.write(json.dumps(answer))
    answers.close()


if __name__ == "__main__":
    main()
