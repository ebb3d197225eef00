"""Results of a benchmark in pieces: a line of JSON for each seed is appended to a file, and the next call does those that are not in it."""

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any


def recorded(file: Path | None, seeds: Iterable[int], one: Callable[[int], dict[str, Any]], seconds: float) -> dict[int, dict[str, Any]]:
    """The results of `one` by seed: those of the file, then those that the time allows, which are added to it."""
    found: dict[int, dict[str, Any]] = {}
    if file is not None and file.exists():
        for line in file.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            found[row.pop("seed")] = row
    began, wanted = time.monotonic(), list(seeds)
    for seed in wanted:
        if seed in found:
            continue
        if time.monotonic() - began > seconds:
            break
        found[seed] = one(seed)
        if file is not None:
            with file.open("a", encoding="utf-8") as out:
                out.write(json.dumps({"seed": seed, **found[seed]}) + "\n")
    return {seed: found[seed] for seed in wanted if seed in found}
