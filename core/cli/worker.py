"""A worker process of `tricap run --workers`: tasks from standard input, an answer for each on standard output, a line of JSON each."""

import json
import os
import sys

from ..foundation import bounded
from ..foundation.errors import InputError
from ..foundation.threads import one_thread_in_linear_algebra
from ..run.workers import Pieces


def main() -> None:
    """Do the tasks until the input ends, or nobody reads the answers any more. A bug ends the process with its traceback."""
    answers = os.dup(1)
    os.dup2(2, 1)  # what libraries print
    pieces = Pieces()
    with one_thread_in_linear_algebra():
        for line in sys.stdin:
            try:
                pieces.run(bounded.json_of(line))
                answer = {}
            except InputError as error:
                answer = {"error": str(error)}
            try:
                os.write(answers, (json.dumps(answer) + "\n").encode())
            except BrokenPipeError:
                return


if __name__ == "__main__":
    main()
