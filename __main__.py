"""`python -m tricap …`, and the console script `tricap`: the commands of the core joined with those that need Blender."""

import os
import sys


def _leave_out_working_folder() -> None:
    """`python -m` looks for modules in the working folder first; neither this process nor its children load any from there."""
    os.environ["PYTHONSAFEPATH"] = "1"
    here = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    if sys.path and sys.path[0] in ("", os.getcwd()) and os.getcwd() != here:
        del sys.path[0]


def main(argv: list[str] | None = None) -> int:
    """Run one command of the `tricap` command line; its exit code (see docs/formats.md)."""
    _leave_out_working_folder()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is there: its own threads would fight ours over small matrices
    from .addon import command

    return command.main(argv)


if __name__ == "__main__":
    sys.exit(main())
