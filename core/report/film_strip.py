"""The first screen's film: the body over frames of the reference view, which a reader plays, or moves through with a slider.

The pictures are in the page once. Those of a few frames are a strip, which is all that paper shows and a browser without scripts;
`SCRIPT` shows all of them one after another. A click on the strip of a limb goes to that frame.
"""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..body.sigma_colours import COLOURS, SIGMAS_MM

MOST_FRAMES = 48  # in the film, besides the doubtful ones
MOST_KEYS = 6  # in the strip, besides the doubtful ones
MOST_DOUBTFUL = 3
PAUSE_MS = (40.0, 200.0)  # between pictures, if the recording's own time is not between these
CELL_PX = 420  # longer side of a picture

SCRIPT = """
for (const film of document.querySelectorAll('.film')) {
  const shots = [...film.querySelectorAll('figure')], stage = film.querySelector('.stage'), now = stage.querySelector('img')
  const slider = stage.querySelector('input'), button = stage.querySelector('button'), words = stage.querySelector('output')
  let timer = null
  const show = i => {
    slider.value = i
    now.src = shots[i].querySelector('img').src
    words.textContent = now.alt = shots[i].querySelector('figcaption').textContent
    for (const svg of document.querySelectorAll('.strip svg')) {
      const place = svg.querySelector('.now')
      if (place) place.setAttribute('x', shots[i].dataset.frame - film.dataset.first + 0.5 - place.width.baseVal.value / 2)
    }
  }
  const nearest = frame => {
    const gaps = shots.map(s => Math.abs(s.dataset.frame - frame))
    return gaps.indexOf(Math.min(...gaps))
  }
  const rest = () => { clearInterval(timer); timer = null; button.textContent = 'Play' }
  button.addEventListener('click', () => {
    if (timer) return rest()
    button.textContent = 'Pause'
    timer = setInterval(() => show((+slider.value + 1) % shots.length), +film.dataset.pause)
  })
  slider.addEventListener('input', () => { rest(); show(+slider.value) })
  shots.forEach((s, i) => s.addEventListener('click', () => { rest(); show(i) }))
  for (const svg of document.querySelectorAll('.strip svg')) svg.addEventListener('click', e => {
    const box = svg.getBoundingClientRect()
    rest()
    show(nearest(+film.dataset.first + Math.floor((e.clientX - box.left) / box.width * svg.viewBox.baseVal.width)))
  })
  slider.max = shots.length - 1
  stage.hidden = false
  show(nearest(+film.dataset.start))
}
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Shot:
    """The body over one frame, as JPEG; `key`: it is in the strip, too."""

    frame: int
    caption: str
    picture: bytes
    key: bool = True


def chosen_frames(count: int, doubtful: Sequence[int]) -> tuple[list[int], set[int]]:
    """Indices of the film's frames, evenly over a recording of `count` frames and those of some doubtful frames; and of the strip's."""
    even, few = (np.unique(np.linspace(0, count - 1, min(n, count)).round().astype(int)).tolist() for n in (MOST_FRAMES, MOST_KEYS))
    keys = {*few, *doubtful[:MOST_DOUBTFUL]}
    return sorted({*even, *keys}), keys


def film(shots: Sequence[Shot], fps: float, start: int, aside: str) -> str:
    """The film, which begins at the frame `start` and is hidden without a script, with HTML beside it, and the strip below both."""
    frames = [shot.frame for shot in shots]
    pause = np.clip(1e3 * (frames[-1] - frames[0]) / max(1, len(frames) - 1) / fps, *PAUSE_MS)
    figures = "".join(_figure(shot) for shot in shots)
    stage = (
        '<div class="stage" hidden><img alt=""><div><button type="button">Play</button>'
        '<input type="range" min="0" value="0" aria-label="frame"></div><output></output></div>'
    )
    opening = f'<div class="film" data-first="{frames[0]}" data-start="{start}" data-pause="{pause:.0f}">'
    return f'{opening}<div class="first">{stage}<div class="aside">{aside}</div></div><div class="row cells">{figures}</div></div>'


def _figure(shot: Shot) -> str:
    text, data = html.escape(shot.caption), base64.b64encode(shot.picture).decode()
    return (
        f'<figure data-frame="{shot.frame}"{"" if shot.key else " hidden"}><img alt="{text}" src="data:image/jpeg;base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def legend() -> str:
    """The colours of the sigmas as a bar with its values."""
    stops = ",".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in COLOURS.tolist())
    values = "".join(f"<span>{value:g} mm{more}</span>" for value, more in zip(SIGMAS_MM.tolist(), (" or less", "", " or more")))
    return (
        f'<div class="legend"><div>Colour: how well the joints are known in this frame (one sigma)</div>'
        f'<i style="background:linear-gradient(90deg,{stops})"></i><div>{values}</div></div>'
    )
