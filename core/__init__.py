"""The pure core of Tricap: photogrammetry of a moving person. No bpy, no printing, no global state."""

import os
import sys

if sys.platform == "linux":
    # OpenCV's loader puts its own folder before LD_LIBRARY_PATH, with a colon even where that is empty, and child processes take an empty
    # entry for the working folder: a stranger's libraries would be loaded from there. This one holds none.
    _entries = [entry for entry in os.environ.get("LD_LIBRARY_PATH", "").split(":") if entry]
    os.environ["LD_LIBRARY_PATH"] = ":".join(_entries) or os.path.dirname(os.path.abspath(__file__))
