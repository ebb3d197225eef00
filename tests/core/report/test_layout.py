"""The layout of the pages, as Chromium makes it: on a phone, a tablet, a screen and on paper, by day and by night.

A page is shown in a frame of the width asked for, and a script beside it measures the boxes of what it shows.
"""

import json
import re
import subprocess
from collections.abc import Callable
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from tricap.core.report.comparison import DEFAULT, METHODS, PUBLISHED, Measure, comparison_page
from tricap.core.report.film_strip import Shot
from tricap.core.report.pages import KINDS, Report, _page
from tricap.core.report.pictures import jpeg
from tricap.core.report.silhouettes import Silhouettes

from .test_page import BROWSER, fitted, needs_browser

LONG = "the_take_of_the_second_afternoon_with_all_of_its_cameras_and_a_name_that_goes_on"
SCHEMES = {"light": {}, "dark": {"(prefers-color-scheme:dark)": "all"}, "paper": {"@media print": "@media all"}}
WIDTHS = {"light": (360, 768, 1200), "dark": (360,), "paper": (794,)}
PROBE = """
const frame = document.querySelector('iframe')
frame.addEventListener('load', () => {
  const page = frame.contentDocument, view = frame.contentWindow, width = page.documentElement.clientWidth
  page.querySelectorAll('details').forEach(d => { d.open = true })
  const faults = [], name = e => `${e.tagName} ${(e.alt || e.textContent).slice(0, 40)}`
  const inside = (a, b) => a.left >= b.left - 1 && a.right <= b.right + 1 && a.top >= b.top - 1 && a.bottom <= b.bottom + 1
  const scrolls = e => e && (['auto', 'scroll'].includes(view.getComputedStyle(e).overflowX) || scrolls(e.parentElement))
  const light = c => { const [r, g, b] = c.match(/[0-9.]+/g).map(v => (v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b + 0.05 }
  const ground = e => { const c = view.getComputedStyle(e).backgroundColor
    return e.parentElement && /, 0\\)$/.test(c) ? ground(e.parentElement) : c }
  if (page.documentElement.scrollWidth > width) faults.push(`it is ${page.documentElement.scrollWidth} px wide`)
  const shown = [...page.body.querySelectorAll('*')].filter(e => e.getClientRects().length)
  for (const e of shown) {
    const box = e.getBoundingClientRect(), style = view.getComputedStyle(e), svg = e.ownerSVGElement
    const words = [...e.childNodes].some(n => n.nodeType == 3 && n.textContent.trim())
    if (svg) {
      if (e.tagName == 'text' && words && !inside(box, svg.getBoundingClientRect())) faults.push(`cut off: ${name(e)}`)
      continue
    }
    if (!scrolls(e) && (box.left < -1 || box.right > width + 1)) faults.push(`beyond the edge: ${name(e)}`)
    if (words && parseFloat(style.fontSize) < 12) faults.push(`too small: ${name(e)}`)
    const [a, b] = [light(style.color), light(ground(e))]
    if (words && e.tagName != 'BUTTON' && Math.max(a, b) / Math.min(a, b) < 4) faults.push(`too pale: ${name(e)} ${style.color}`)
  }
  for (const picture of page.querySelectorAll('figure img')) {
    const box = picture.getBoundingClientRect(), words = picture.parentNode.querySelector('figcaption').getBoundingClientRect()
    if (!box.width && !words.width) continue
    const asked = picture.naturalWidth / picture.naturalHeight
    if (Math.abs(box.width / box.height / asked - 1) > 0.02) faults.push(`distorted: ${name(picture)}`)
    if (words.top < box.bottom - 1 || words.height < 10) faults.push(`no caption below: ${name(picture)}`)
  }
  const boxes = [...page.querySelectorAll('figure, svg.graph, h1, h2, summary, .verdict, nav')].map(e => e.getBoundingClientRect())
  const seen = boxes.filter(b => b.width)
  for (const [i, a] of seen.entries()) for (const b of seen.slice(i + 1))
    if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1)
      faults.push(`one over another at ${Math.round(b.top)}`)
  const levels = [...page.querySelectorAll('h1, h2, h3, h4')].map(h => +h.tagName[1])
  if (levels[0] != 1 || levels.some((level, i) => i && level > levels[i - 1] + 1)) faults.push(`headings ${levels}`)
  const out = document.createElement('pre'); out.id = 'probe'
  out.textContent = JSON.stringify({faults, width, boxes: boxes.map(b => [b.left, b.top, b.width, b.height].map(Math.round))})
  document.body.append(out)
})
frame.srcdoc = source
"""


def report_page(tmp_path: Path) -> str:
    """A report with every kind of picture, of one, two and five panels, with long names and a film."""
    take = SimpleNamespace(clicks=SimpleNamespace(frame=1, joints={"elbow.R": {}}), keyframes=())
    record = {
        "take": LONG, "views": ["L", "C", "R"], "frames": [0, 3], "fps": 25.0, "interlaced": "odd", "warnings": ["The arm is guessed."],
        "stages": {"fit": {"note": "a/" + LONG}}, "settings": {"skin": {"rays": 32}}, "repeat": f"tricap run /films/{LONG} --out {LONG}",
    }  # fmt: skip
    report = Report(
        footage=SimpleNamespace(take=take), record=record, clouds=[], trajectories=None, body=fitted(), silhouettes=Silhouettes(),  # type: ignore[arg-type]
    )  # fmt: skip
    sizes = {"layers": (520, 1650), "vectors": (450, 720), "trails": (520, 720)}
    files = {}
    for kind in sum(KINDS.values(), ()):
        picture = jpeg(np.full((*sizes.get(kind, (300, 400)), 3), 90, np.uint8))
        names = [kind] if kind == "layers" else [f"{kind}_{i:04d}" for i in range(3)]
        files |= {f"{name}.png": (f"Frame 3, view C: {kind}, from the front and from its right side", picture) for name in names}
    shots = [Shot(frame=i, caption=f"Frame {i}", picture=jpeg(np.full((520, 400, 3), 90, np.uint8)), key=True) for i in range(7)]
    rows = [{"name": f"elbow.R flexion, {LONG}", "value": 1.0, "sigma": 0.1, "unit": "mm", "sigma_of": "the mean of all frames"}]
    return _page(report, rows, files, shots)


def compared_page(tmp_path: Path) -> str:
    """The page of `tricap compare` with two pairs of pictures."""
    for method in METHODS:
        (tmp_path / method / "report").mkdir(parents=True)
        for name, size in (("surface_0003.png", (300, 400)), ("vectors_velocity.png", (450, 720))):
            cv2.imwrite(str(tmp_path / method / "report" / name), np.full((*size, 3), 90, np.uint8))
    measure = Measure(
        name="places of trajectories off by 10 mm or more", unit="frames", published=1.0, default=2.0, better="lower", group="Surface"
    )
    return comparison_page(LONG, [measure], {m: tmp_path / m for m in (PUBLISHED, DEFAULT)}, [f"It began from {LONG}."])


def measured(tmp_path: Path, text: str, width: int) -> dict[str, Any]:
    """What the probe measures of a page in a frame of this width."""
    path, source = tmp_path / "probe.html", json.dumps(text).replace("</", "<\\/").replace("<!--", "<\\!--")
    frame = f'<iframe style="border:0;width:{width}px;height:900px"></iframe>'
    path.write_text(f'<body style="margin:0">{frame}<script>const source = {source}\n{PROBE}</script>', encoding="utf-8")
    command = [str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
               "--window-size=1300,950", "--enable-logging=stderr", "--dump-dom", path.as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    found = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    seen: dict[str, Any] = json.loads(unescape(found[1]))
    seen["console"] = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return seen


@needs_browser
@pytest.mark.parametrize("made", [report_page, compared_page])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_nothing_is_cut_off_pale_or_out_of_place(tmp_path: Path, made: Callable[[Path], str], scheme: str) -> None:
    text = made(tmp_path)
    for old, new in SCHEMES[scheme].items():
        assert old in text
        text = text.replace(old, new)
    for width in WIDTHS[scheme]:
        seen = measured(tmp_path, text, width)
        assert seen["faults"] == [] and seen["console"] == [] and seen["width"] >= width - 20, (width, seen["console"])
        assert len(seen["boxes"]) > 4


@needs_browser
def test_night_changes_colours_alone(tmp_path: Path) -> None:
    text = report_page(tmp_path)
    light, dark = (measured(tmp_path, text.replace(*change), 768)["boxes"] for change in (("", ""), ("(prefers-color-scheme:dark)", "all")))
    assert light == dark


@needs_browser
def test_each_fault_is_found(tmp_path: Path) -> None:
    wrong = {
        '<div style="width:900px">wide</div>': "it is",
        '<p style="color:#bbb">pale</p>': "too pale",
        '<p style="font-size:7px">small</p>': "too small",
        '<svg width="40" height="20"><text y="15">a long label</text></svg>': "cut off",
        '<script>throw new Error("x")</script>': "",
        "<h4>deep</h4>": "headings 1,4,2",
        '<h2 style="margin-bottom:-3em">over</h2>': "one over another",
    }
    text = report_page(tmp_path).replace("</h1>", f"</h1>{''.join(wrong)}", 1)
    seen = measured(tmp_path, text, 600)
    assert not [said for said in wrong.values() if not any(said in fault for fault in seen["faults"])] and len(seen["console"]) == 1
