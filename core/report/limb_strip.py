"""A strip for each limb over the frames: where it was seen, inferred or guessed. As wide as the page, on a phone, too."""

import html
from collections.abc import Mapping, Sequence

from ..body.limb_words import runs
from ..body.motion import GUESSED, INFERRED, SEEN

MEANING = (
    "Seen: the images show it. Inferred: its place follows from other frames and limbs, or is only known to some centimetres. Guessed: the "
    "images contradict it, or do not show where it is."
)
STYLES = {SEEN: ("#28a066", 0.35), INFERRED: ("#c98a1b", 0.7), GUESSED: ("#d1495b", 1.0)}  # colour, and height as a share of the row
BAR = 16  # height of a row


def limb_strip(frames: Sequence[int], words: Mapping[str, Sequence[str]]) -> str:
    """One row of bars for each limb, whose `words` are those of the frames (T,); "" without any. Doubt is higher, not only redder."""
    if not words or not len(frames):
        return ""
    first, count = frames[0], frames[-1] + 1 - frames[0]
    rows, now = [], f'<rect class="now" x="-9" width="{count / 90:.3f}" height="{BAR}" fill="currentColor"/>'
    for limb, row in words.items():
        bars = "".join(_bar(limb, a, b, word, first) for a, b, word in runs(frames, row))
        rows.append(
            f'<span>{html.escape(limb)}</span><svg viewBox="0 0 {count} {BAR}" preserveAspectRatio="none" role="img" '
            f'xmlns="http://www.w3.org/2000/svg" aria-label="{html.escape(limb)} over the frames">{bars}{now}</svg>'
        )
    ends = f"<span></span><div><span>frame {first}</span><span>{frames[-1]}</span></div>"
    meaning = "".join(
        f'<span><i style="height:{BAR * share:.0f}px;background:{colour}"></i>{word}</span>' for word, (colour, share) in STYLES.items()
    )
    return f'<div class="strip">{"".join(rows)}{ends}<span></span><div>{meaning}</div></div>'


def _bar(limb: str, a: int, b: int, word: str, first: int) -> str:
    """The bar of the frames a to b."""
    colour, share = STYLES[word]
    name = f"{limb}: {word} in frame {a}" if a == b else f"{limb}: {word} in frames {a} to {b}"
    return (
        f'<rect x="{a - first}" y="{BAR * (1 - share):.1f}" width="{b + 1 - a}" height="{BAR * share:.1f}" fill="{colour}">'
        f"<title>{html.escape(name)}</title></rect>"
    )
