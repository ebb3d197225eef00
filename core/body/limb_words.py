"""How well each limb is known in each frame, in words: those of its joints together (`BodyMotion.known`)."""

from collections.abc import Mapping, Sequence

import numpy as np

from .motion import GUESSED, KNOWN, SEEN

LIMBS = {"arm": ("elbow", "wrist"), "leg": ("knee", "ankle")}  # the joints that a limb moves
CARRIED = ("knuckles", "toe")  # move with a limb's end, and are no part of its word
SIDES = {"R": "right", "L": "left"}
TRUNK = "trunk and head"
FEW_FRAMES = 5  # that are not worth a warning
MOST_SPANS = 8  # of frames, that a line lists


def limb_joints(joints: Sequence[str]) -> dict[str, list[int]]:
    """The joints of each limb, by its name in words: "left arm" -> indices of elbow.L and wrist.L; only limbs that there are."""
    names = [TRUNK, *(f"{side} {limb}" for limb in LIMBS for side in SIDES.values())]
    found: dict[str, list[int]] = {name: [] for name in names}
    for i, joint in enumerate(joints):
        name, _, side = joint.partition(".")
        if name in CARRIED:
            continue
        limb = next((limb for limb, names in LIMBS.items() if name in names), "")
        found[f"{SIDES[side]} {limb}" if limb and side in SIDES else TRUNK].append(i)
    return {limb: indices for limb, indices in found.items() if indices}


def limb_words(joints: Sequence[str], known: Sequence[Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """By limb the word of each frame: that of its least known joint; `known` (T, J)."""
    rank = np.array([[KNOWN.index(word) for word in row] for row in known], dtype=int).reshape(len(known), len(joints))
    return {limb: tuple(KNOWN[k] for k in rank[:, columns].max(axis=1).tolist()) for limb, columns in limb_joints(joints).items()}


def counts(words: Mapping[str, Sequence[str]]) -> dict[str, dict[str, int]]:
    """By limb in how many frames it is seen, inferred and guessed."""
    return {limb: {word: list(row).count(word) for word in KNOWN} for limb, row in words.items()}


def runs(frames: Sequence[int], row: Sequence[str]) -> list[tuple[int, int, str]]:
    """Successive frames of the same word: first, last and word."""
    found: list[tuple[int, int, str]] = []
    for frame, word in zip(frames, row):
        if found and found[-1][2] == word:
            found[-1] = (found[-1][0], int(frame), word)
        else:
            found.append((int(frame), int(frame), word))
    return found


def sentence(limb: str, frames: Sequence[int], row: Sequence[str]) -> str:
    """One limb in a line: "left arm: seen in 20 frames, guessed in 3 (7–9)"."""
    parts = []
    for word in KNOWN:
        spans = [f"{a}" if a == b else f"{a}–{b}" for a, b, w in runs(frames, row) if w == word]
        if spans:
            n = list(row).count(word)
            where = "" if word == SEEN else f" ({', '.join(spans[:MOST_SPANS])}{' …' if len(spans) > MOST_SPANS else ''})"
            parts.append(f"{word} in {'all' if n == len(row) else n} {'frame' if n == 1 else 'frames'}{where if n < len(row) else ''}")
    return f"{limb}: {', '.join(parts)}"


def frame_list(frames: Sequence[int], most: int | None = None) -> str:
    """Frames in words, at most so many spans of them: “3, 7–9”."""
    spans = runs(frames, [str(frame - k) for k, frame in enumerate(frames)])  # the same for successive frames
    words = [f"{a}" if a == b else f"{a}–{b}" for a, b, _ in spans[:most]]
    return ", ".join(words) + (" …" if most is not None and len(spans) > most else "")


def to_click(joints: Sequence[str], known: Sequence[Sequence[str]], limb: str, word: str) -> list[str]:
    """Which joints of a limb have this word in most frames, so that clicks there tell most; `known` (T, J)."""
    has = {joints[j]: sum(row[j] == word for row in known) for j in limb_joints(joints)[limb]}
    return [joint for joint, count in has.items() if count == max(has.values())]


def guessed_frames(frames: Sequence[int], row: Sequence[str]) -> tuple[int, ...]:
    """The frames in which a limb is guessed."""
    return tuple(int(frame) for frame, word in zip(frames, row) if word == GUESSED)
