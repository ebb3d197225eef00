"""A strip for each limb over the frames, as SVG: where it was seen, inferred or guessed."""

import html
from collections.abc import Mapping, Sequence

from ..body.limb_words import runs
from ..body.motion import GUESSED, INFERRED, SEEN
from .graphs import TEXT

MEANING = (
    "Seen: the images show it. Inferred: its place follows from other frames and limbs, or is only known to some centimetres. Guessed: the "
    "images contradict it, or do not show where it is."
)
STYLES = {SEEN: ("#28a066", 0.35), INFERRED: ("#c98a1b", 0.7), GUESSED: ("#d1495b", 1.0)}  # colour, and height as a share of the row
WIDTH, LEFT, ROW, FOOT = 1040, 120, 22, 40
BAR = 16  # of a row, when it is full


def limb_strip(frames: Sequence[int], words: Mapping[str, Sequence[str]]) -> str:
    """One row of bars for each limb, whose `words` are those of the frames (T,); "" without any. Doubt is higher, not only redder."""
    if not words or not len(frames):
        return ""
    scale, first, bottom = (WIDTH - LEFT - 10) / (frames[-1] + 1 - frames[0]), frames[0], ROW * len(words)
    parts = [
        f'<svg class="strip" viewBox="0 0 {WIDTH} {bottom + FOOT}" width="{WIDTH}" xmlns="http://www.w3.org/2000/svg" role="img" '
        f'aria-label="Limbs over the frames: seen, inferred, guessed" {TEXT}>'
    ]
    for k, (limb, row) in enumerate(words.items()):
        base = ROW * (k + 1) - 3
        parts.append(f'<text x="{LEFT - 8}" y="{base - 3}" text-anchor="end">{html.escape(limb)}</text>')
        for a, b, word in runs(frames, row):
            colour, share = STYLES[word]
            name = f"{limb}: {word} in frame {a}" if a == b else f"{limb}: {word} in frames {a} to {b}"
            parts.append(
                f'<rect x="{LEFT + (a - first) * scale:.1f}" y="{base - BAR * share:.1f}" width="{(b + 1 - a) * scale:.1f}" '
                f'height="{BAR * share:.1f}" fill="{colour}"><title>{html.escape(name)}</title></rect>'
            )
    parts.append(f'<text x="{LEFT}" y="{bottom + 14}">frame {first}</text>')
    parts.append(f'<text x="{WIDTH - 10}" y="{bottom + 14}" text-anchor="end">{frames[-1]}</text>')
    for k, (word, (colour, share)) in enumerate(STYLES.items()):
        x = LEFT + 110 * k
        parts.append(f'<rect x="{x}" y="{bottom + 36 - BAR * share:.1f}" width="22" height="{BAR * share:.1f}" fill="{colour}"/>')
        parts.append(f'<text x="{x + 28}" y="{bottom + 35}">{word}</text>')
    return "".join([*parts, "</svg>"])
