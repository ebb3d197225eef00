"""`python -m tricap …`, and the console script `tricap`: the commands of the core joined with those that need Blender."""

import os
import sys

LEAST_MB = 800  # of memory: below, OpenBLAS may end the process, which nothing can catch


def _leave_out_working_folder() -> None:
    """`python -m` looks for modules in the working folder first; neither this process nor its children load any from there."""
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        working = os.getcwd()
    except OSError:  # it was deleted
        working = ""
    here = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    if sys.path and sys.path[0] in ("", working) and working != here:
        del sys.path[0]


def _too_little_memory() -> str:
    """What to say of a limit of this process's memory under which no command can run; "" if there is none."""
    if sys.platform == "win32":
        return ""
    import resource

    limits = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
    least = min((limit >> 20 for limit in limits if limit >= 0 and limit != resource.RLIM_INFINITY), default=LEAST_MB)
    if least >= LEAST_MB:
        return ""
    return f"Tricap needs {LEAST_MB} MB of memory, and the limit is {least} MB. Raise the limit (ulimit -v, -d)."


def main(argv: list[str] | None = None) -> int:
    """Run one command of the `tricap` command line; its exit code (see docs/formats.md)."""
    _leave_out_working_folder()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is there: its own threads would fight ours over small matrices
    too_little = _too_little_memory()
    if too_little:
        from .core.cli import streams

        with streams.robust():
            streams.write_line(f"tricap: {too_little}", sys.stderr)
        return 2
    try:
        from .addon import command

        return command.main(argv)
    except KeyboardInterrupt:  # before the command has begun, or a second Ctrl-C
        return 130


if __name__ == "__main__":
    sys.exit(main())
