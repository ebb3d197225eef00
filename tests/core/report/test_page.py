"""The page of the report: its first screen, names from elsewhere, trails, and what a browser makes of it."""

import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from base64 import b64encode
from dataclasses import replace
from hashlib import sha256
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tricap.core.body.model_file import read_model
from tricap.core.body.motion import BRIDGED, PARTIAL, SUSPECT, BodyFit, BodyMotion
from tricap.core.body.shape import default_shape
from tricap.core.body.sigma_colours import sigma_colours
from tricap.core.body.skin.contour_skin import SkinSettings
from tricap.core.foundation import store
from tricap.core.report import overview
from tricap.core.report.arrangement import arrangement, plan, words
from tricap.core.report.close_up import alike, close_up
from tricap.core.report.document import STYLE, document, figure, notes, table
from tricap.core.report.drawing import GROUND, OF_PANELS, TITLE_PX
from tricap.core.report.figures import figures_csv
from tricap.core.report.film_strip import MOST_FRAMES, Shot, chosen_frames
from tricap.core.report.graphs import SCRIPT, curve_graph
from tricap.core.report.limb_strip import limb_strip
from tricap.core.report.overview import NOT_WANTED, WHY, body_by_sigma, bone_sigma_mm, headline, joint_words, verdict
from tricap.core.report.pages import Report, _page, limb_of
from tricap.core.report.person import skin_in
from tricap.core.report.pictures import jpeg
from tricap.core.report.silhouettes import Silhouettes
from tricap.core.report.trails import KEPT_COLOUR, SIDE_PX, longest_vectors, trail_pictures, vector_pictures
from tricap.core.run.record import REASONS
from tricap.core.tracking.reasons import COLOUR_WORDS, MEANINGS, REASON_COLOURS
from tricap.core.tracking.settings import TrackStatus
from tricap.core.tracking.trajectories import with_kinematics

BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="Chromium is not installed (Debian: chromium)")
ARM = default_shape(read_model("arm.R"))
NASTY = "<img src=x onerror=alert(1)>"
PROBE = """
const seen = {errors: window.failed, width: document.documentElement.scrollWidth, inner: innerWidth}
seen.columns = getComputedStyle(document.querySelector('.row.graphs')).gridTemplateColumns.split(' ').length
seen.keys = [...document.querySelectorAll('.cells figure')].filter(f => f.offsetHeight).length
const stage = document.querySelector('.stage'), slider = stage.querySelector('input')
seen.film = [stage.hidden, slider.max, slider.value, stage.querySelector('output').textContent]
slider.value = 5; slider.dispatchEvent(new Event('input')); seen.place = document.querySelector('.strip .now').getAttribute('x')
const strip = document.querySelector('.strip svg'), bar = strip.getBoundingClientRect()
strip.dispatchEvent(new MouseEvent('click', {clientX: bar.left + 0.9 * bar.width})); seen.clicked = slider.value
stage.querySelector('button').click(); seen.playing = stage.querySelector('button').textContent
const figure = document.querySelector('.row:not(.cells) figure'), before = figure.offsetWidth
figure.querySelector('img').click(); seen.larger = figure.offsetWidth / before
seen.paper = getComputedStyle(document.body).backgroundColor
const svg = document.querySelector('svg.graph'), box = svg.getBoundingClientRect(), at = x => box.left + box.width * x / 520
const send = (kind, x) => svg.dispatchEvent(new PointerEvent(kind, {clientX: at(x), clientY: box.top + 50}))
send('pointermove', 509); seen.read = svg.querySelector('.read').textContent
send('pointerdown', 56 + 227); send('pointerup', 510); seen.zoomed = [...svg.querySelectorAll('.end')].map(e => e.textContent)
svg.dispatchEvent(new MouseEvent('dblclick')); seen.whole = svg.querySelector('.end').textContent
dispatchEvent(new Event('beforeprint')); seen.open = document.querySelectorAll('details[open]').length
const out = document.createElement('pre'); out.id = 'probe'; out.textContent = JSON.stringify(seen); document.body.append(out)
"""


def fitted(**changes: Any) -> BodyFit:
    """An arm in three frames, well known but for its wrist."""
    d, j = len(ARM.skeleton.dofs), len(ARM.skeleton.joint_names)
    values = np.zeros((3, d))
    values[:, :3] = 0.15, 0.0, 2.6
    sigma = np.full((3, j), 0.002)
    sigma[:, ARM.skeleton.joint_names.index("wrist.R")] = 0.060
    motion = BodyMotion(
        frames=np.arange(3), time_s=np.arange(3) / 25, dof_names=ARM.skeleton.dof_names, values=values,
        covariance=np.tile(np.eye(d) * 1e-4, (3, 1, 1)), joint_names=ARM.skeleton.joint_names,
        joints_m=np.zeros((3, j, 3)) + [0.15, 0.0, 2.6], joint_sigma_m=sigma, joint_frame_sigma_m=sigma, known=(("seen",) * j,) * 3,
        status=("fitted", "fitted", "partial"), sigma0=np.ones(3),
    )  # fmt: skip
    given = dict(shape=ARM, motion=motion, iterations=3, converged=True, points=np.zeros((3, 2)), outline_m=np.zeros(0))
    return BodyFit(**{**given, **changes})  # type: ignore[arg-type]


def test_the_verdict_reports_doubt_before_anything_sounds_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    record = {"stages": {"measure": {"frames": 3, "points_per_frame": 1234.0, "sigma_mm": 0.4}, "fit": {"not_done": "no clicked joints"}}}
    assert "1,234 points a frame" in verdict(record, None) and headline(record, None, 0) == "No body was fitted: no clicked joints."
    assert "No surface was measured: nothing" in verdict({"stages": {"measure": {"not_done": "nothing"}}}, None)
    assert "no body" in headline({"stages": {"fit": {"not_done": NOT_WANTED}}}, None, 0)
    good = verdict(record, fitted())
    assert "fitted in 3 frames. Its joints are known to" in good and good.endswith("Least certain is the right wrist, with 60 mm.")
    assert headline(record, fitted(), 0) == "No frame stands out as doubtful."
    assert headline(record, fitted(), 1).startswith("Usable, but look at 1 frame: the worst is below")
    assert headline(record, fitted(), 2).startswith("Usable, but look at 2 frames: the worst are below")
    names = ARM.skeleton.joint_names
    monkeypatch.setattr(overview, "FEW_FRAMES", 0)
    rows = [tuple(word if name == "wrist.R" else "seen" for name in names) for word in ("seen", "guessed", "guessed")]
    unseen = fitted(motion=replace(fitted().motion, known=tuple(rows)))
    assert "In 2 of them the images do not show a limb well" in verdict(record, unseen)
    assert headline(record, unseen, 2) == "Usable, but some of it is guessed: the right arm in frames 1–2."
    assert "has not converged" in headline(record, fitted(converged=False), 0)
    contradicted = fitted(contradicted={"forearm.R": (0, 1)}, converged=False)
    assert headline(record, contradicted, 1).startswith("The images contradict the body in 2 frames")
    assert joint_words("crown") == "top of the head" and joint_words("neck") == "neck"


def test_every_reason_has_a_sentence() -> None:
    """Of the reasons that a run gives for doubtful frames."""
    assert {*REASONS.values(), *(f"fit {status}" for status in (BRIDGED, PARTIAL, SUSPECT))} == {*WHY}


def test_limbs_are_coloured_by_their_sigma(scenes: Any) -> None:
    """From blue to red; not finite is red. In the picture the forearm, whose wrist is uncertain, is redder than the upper arm."""
    blue, yellow, red, unknown = sigma_colours(np.array([0.1, 7.0, 500.0, np.nan])).tolist()
    assert blue[2] > blue[0] and yellow[1] > 200 and red[0] > 200 and unknown == red
    body, camera = fitted(), scenes.three_cameras()["C"]
    assert bone_sigma_mm(body, 0).tolist() == [2.0, 60.0]
    skin_at = skin_in(Path("nowhere"), body, SkinSettings())
    assert skin_at is not None
    skin = skin_at(body.motion.values[0])
    part = close_up(camera, [skin.vertices_m], 300).around(skin.vertices_m)
    picture = body_by_sigma(part.image(np.full((150, 200), 90.0, np.float32)), part.camera, skin, bone_sigma_mm(body, 0))
    assert max(picture.shape[:2]) == 300
    redness = picture[..., 2].astype(int) - picture[..., 0]
    assert redness.min() < -10 and redness.max() > 60 and (redness == 0).mean() > 0.4


def test_a_close_up_shows_the_same_points_larger(scenes: Any) -> None:
    """A dot of the image lies where the part's camera projects it; windows lie within the image, also about points at its edge."""
    camera = scenes.three_cameras()["C"]
    xyz = np.array([0.03, -0.02, 2.1]) + 0.04 * np.random.default_rng(1).uniform(-1, 1, (50, 3))
    view = close_up(camera, [xyz, xyz + [0.05, 0, 0]], 300)
    part = view.around(xyz)
    assert np.allclose(part.pixels(camera.project(xyz)), part.camera.project(xyz), atol=1e-6)
    assert part.scale > 1.5 and max(part.camera.size_px) == 300
    dot = np.zeros(camera.size_px[::-1], np.float32)
    x, y = np.rint(camera.project(xyz[0])).astype(int)
    dot[y, x] = 255
    found = np.unravel_index(part.image(dot).argmax(), part.camera.size_px[::-1])
    assert np.abs(np.array(found[::-1]) - part.camera.project(xyz[0])).max() < 1.5 * part.scale
    aside = view.around(camera.points_at_depth(np.tile([1.0, 1.0], (9, 1)), 2.0))
    assert aside.corner_px.tolist() == [0, 0] and view.around(xyz[:1]).part_px == view.part_px
    assert close_up(camera, [xyz[:2]]).part_px == camera.size_px, "too few points"
    other = close_up(camera, [xyz + [0, 0.08, 0], xyz], 300)
    assert len({v.part_px for v in alike([view, other])}) == 1 and len({v.part_px for v in (view, other)}) == 2


def test_the_recording_from_above(scenes: Any) -> None:
    """Distances, angle and size of a pixel in the caption; the person is drawn as far above the cameras as it is in front of them."""
    rig = scenes.three_cameras()
    clouds = [SimpleNamespace(xyz_m=np.array([[0.02 * t, 0.0, 2.0]]) + np.zeros((4, 1))) for t in range(3)]
    shown = arrangement(rig, 1, clouds)  # type: ignore[arg-type]
    assert shown is not None and arrangement(rig, 1, [SimpleNamespace(xyz_m=np.zeros((0, 3)))]) is None  # type: ignore[list-item]
    centres = [c.centre_m for c in rig.cameras]
    apart = max(np.linalg.norm(a - b) for a in centres for b in centres)
    depth = rig.cameras[1].to_camera(np.array([0.02, 0, 2.0]))[2]
    assert f"{depth:.2f} m in front of camera C" in words(shown) and f"{apart:.2f} m apart" in words(shown)
    assert f"A pixel is {1e3 * depth / rig.cameras[1].focal_px:.1f} mm" in words(shown)
    svg = ET.fromstring(plan(shown))
    circles = [c.attrib for c in svg.iter("{http://www.w3.org/2000/svg}circle")]
    dots, cameras = ([float(c["cy"]) for c in circles if c["r"] == r] for r in ("1.4", "4"))
    assert len(dots) == 4 and len(cameras) == 3 and max(dots) < min(cameras)


def test_the_strip_of_limbs_names_runs_of_frames() -> None:
    strip = limb_strip([4, 5, 6], {"left arm": ("seen", "guessed", "guessed"), "<leg>": ("seen",) * 3})
    assert strip.count("<title>") == 3 and "left arm: guessed in frames 5 to 6" in strip and "left arm: seen in frame 4" in strip
    assert "&lt;leg&gt;" in strip and "<leg>" not in strip and limb_strip([], {}) == ""


def test_frames_of_the_film_and_of_the_strip() -> None:
    frames, keys = chosen_frames(100, [50, 3, 7, 9])
    assert keys == {0, 3, 7, 20, 40, 50, 59, 79, 99} and {*frames} > keys and len(frames) <= MOST_FRAMES + len(keys)
    assert chosen_frames(1, []) == ([0], {0})


def test_graphs_are_grouped_by_limb() -> None:
    found = [limb_of(name) for name in ("elbow.R flexion", "toe.L flexion", "neck flexion", "clavicle.L twist")]
    assert found == ["Right arm", "Left leg", "Trunk and head", "Left arm"]


def test_figures_as_a_table() -> None:
    rows = [{"name": 'length, "arm"', "value": 2.5, "sigma": float("nan"), "unit": "mm", "sigma_of": "x"}]
    assert figures_csv(rows) == 'name,value,sigma,unit,sigma_of\n"length, ""arm""",2.5,,mm,x\n'


def raw(path: Path, status: np.ndarray) -> Path:
    """A trajectories_raw.npz of points that move to the right, 2 m ahead; NaN where the status is 0."""
    t, n = status.shape
    xyz = np.zeros((t, n, 3)) + [0, 0, 2.0]
    xyz[..., 0] += 0.02 * np.arange(t)[:, None]
    xyz[..., 1] += 0.05 * np.arange(n)
    store.save(path, dict(frames=np.arange(t), xyz_m=np.where(status[..., None] > 0, xyz, np.nan).astype(np.float32), status=status), {})
    return path


def test_trails_before_and_after_the_filters(scenes: Any, tmp_path: Path) -> None:
    camera = scenes.three_cameras()["C"]
    status = np.full((6, 4), TrackStatus.MEASURED, dtype=np.int8)
    status[2:, 1], status[:, 2] = TrackStatus.TOO_FAST, TrackStatus.ABSENT
    (every, before), (removed, red), (kept, green) = trail_pictures(raw(tmp_path / "raw.npz", status), camera)
    assert "All 18 tracked" in every and "The 4 removed" in removed and "The 14 positions that were kept" in kept
    assert before.shape[1] == 2 * SIDE_PX < 2 * before.shape[0]
    top = round(TITLE_PX * OF_PANELS)
    before, panels, green = (picture[top : top + SIDE_PX] for picture in (before, red, green))

    def has(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
        """A pixel between the ground and this colour: lines are as thin as a pixel, and smooth."""
        over, wanted = picture.astype(float) - GROUND, np.subtract(colour, GROUND)
        size = np.linalg.norm(over, axis=2)
        return bool((over @ wanted > 0.99 * size * np.linalg.norm(wanted))[size > 40].any())

    assert has(panels, REASON_COLOURS[TrackStatus.TOO_FAST]) and not has(panels, KEPT_COLOUR) and has(green, KEPT_COLOUR)
    assert not has(panels, REASON_COLOURS[TrackStatus.UNCERTAIN]) and not (panels == 255).all(axis=2).any(), "no words on the trails"
    legend = red[top + SIDE_PX :].reshape(-1, 3)
    for colour, meaning in MEANINGS:
        assert (legend == colour).all(axis=1).sum() > 100, f"a swatch of {meaning}"
    assert COLOUR_WORDS in removed and {*REASON_COLOURS.values()} < {colour for colour, _ in MEANINGS}
    assert before.any() and not has(before, REASON_COLOURS[TrackStatus.TOO_FAST])
    assert trail_pictures(tmp_path / "none.npz", camera) == []
    assert trail_pictures(raw(tmp_path / "empty.npz", np.zeros((3, 2), dtype=np.int8)), camera) == []


def test_vectors_point_where_the_points_go(scenes: Any) -> None:
    """Three points that go to the right faster and faster: arrows to the right in front, none from the side, with the sizes in words."""
    camera = scenes.three_cameras()["C"]
    t = np.arange(5.0)[:, None, None]
    right = camera.R_cam_world[0]
    xyz = (
        2.0 * camera.R_cam_world[2]
        + camera.centre_m
        + np.linspace(-0.1, 0.1, 3)[:, None] * camera.R_cam_world[1]
        + 0.5 * t**2 * 0.01 * right
    )
    tracks = with_kinematics(np.arange(5), np.arange(5) / 10, xyz, np.full((5, 3), 1e-3), np.ones((5, 3), dtype=np.int8), 0)
    longest = longest_vectors(tracks, 2)
    (speed, front_and_side), (bend, _) = vector_pictures(tracks, camera, 2, longest).values()
    assert "velocities of 3 tracked points" in speed and "longest: 0.2 m/s" in speed and "longest: 1 m/s²" in bend
    front, side = np.split(front_and_side, 2, axis=1)
    red = [(p[..., 2].astype(int) - p[..., 0] > 60) & (p[..., 1] < 120) for p in (front, side)]
    columns = [len(np.unique(np.nonzero(r)[1])) for r in red]
    assert columns[0] > 15 and columns[0] > 2 * columns[1]
    empty = with_kinematics(np.arange(1), np.arange(1) / 10, xyz[:1], np.full((1, 3), 1e-3), np.ones((1, 3), dtype=np.int8), 0)
    assert longest_vectors(empty, 0) == {} == vector_pictures(empty, camera, 0, longest), "a single frame has no velocities"
    (slow, paler), _ = vector_pictures(tracks, camera, 2, longest | {"velocity": 0.8}).values()
    hue = np.split(paler, 2, axis=1)[0][round(TITLE_PX * OF_PANELS) :][:SIDE_PX]
    assert "longest: 0.8 m/s" in slow and not ((hue[..., 2].astype(int) - hue[..., 0] > 60) & (hue[..., 1] < 120)).any()


def page(tmp_path: Path) -> Path:
    """A page as the report makes it, of an arm, with names that are no names."""
    take = SimpleNamespace(clicks=SimpleNamespace(frame=1, joints={"elbow.R": {}}), keyframes=())
    record = {
        "take": f"/films/{NASTY}", "views": [NASTY, "C"], "frames": [0, 3], "fps": 25.0, "interlaced": "none", "warnings": [NASTY],
        "stages": {"fit": {"note": NASTY}}, "settings": {"skin": {"k": NASTY}}, "repeat": f"tricap run {NASTY}",
    }  # fmt: skip
    report = Report(
        footage=SimpleNamespace(take=take), record=record, clouds=[], trajectories=None, body=fitted(), silhouettes=Silhouettes(),  # type: ignore[arg-type]
    )  # fmt: skip
    rows = [{"name": NASTY, "value": 1.0, "sigma": 0.1, "unit": "mm", "sigma_of": NASTY}]
    picture = jpeg(np.full((300, 400, 3), 90, np.uint8))
    files = {f"surface_{i:04d}.png": (f"Frame {i}: {NASTY}", picture) for i in range(3)}
    path = tmp_path / "report.html"
    shots = [Shot(frame=i, caption=NASTY, picture=picture, key=i != 1) for i in range(7)]
    path.write_text(_page(report, rows, files, shots))
    return path


def test_names_are_text(tmp_path: Path) -> None:
    text = page(tmp_path).read_text()
    assert NASTY not in text and "&lt;img src=x onerror=alert(1)&gt;" in text
    assert (
        not re.search(r'(src|href)="(?!data:|#)', text)
        and "http://" not in text.replace("http://www.w3.org", "")
        and "https://" not in text
    )
    assert text.index('class="verdict"') < text.index("<figure") < text.index(">Over time</h2>") < text.index(">All figures</h2>")


@needs_browser
@pytest.mark.parametrize(("width", "columns", "scheme"), [(1200, 2, "light"), (500, 1, "dark"), (794, 2, "paper")])
def test_a_browser_shows_the_page(tmp_path: Path, width: int, columns: int, scheme: str) -> None:
    """No error, no scrolling sideways, as many columns as fit, dark where that is asked for, graphs that are read and enlarged."""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page(tmp_path).read_text(), count=1)  # for the test's own script
    watch = "window.failed = []; addEventListener('error', e => failed.push(e.message))"
    allowed = " ".join(f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'" for code in (watch, PROBE))
    text = text.replace("script-src ", f"script-src {allowed} ")  # besides the page's own script
    if scheme != "light":
        text = text.replace(
            {"dark": "(prefers-color-scheme:dark)", "paper": "@media print"}[scheme], {"dark": "all", "paper": "@media all"}[scheme]
        )
    graph = curve_graph("first", "°", np.arange(11), {"a": 2.0 * np.arange(11)}, np.full(11, 1.0), limits=(-5.0, 15.0), marks=[4])
    text = text.replace("<h1>", f"<script>{watch}</script>{graph}<h1>", 1).replace("</body>", f"<script>{PROBE}</script></body>")
    (tmp_path / "probe.html").write_text(text)
    command = [str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
               f"--window-size={width},900", "--dump-dom", (tmp_path / "probe.html").as_uri()]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    found = re.search(r'<pre id="probe">(.*?)</pre>', dom, re.DOTALL)
    assert found, dom[-2000:]
    seen = json.loads(unescape(found[1]))
    assert seen["errors"] == [] and seen["width"] <= seen["inner"] and seen["columns"] == columns
    assert seen["paper"] == ("rgb(27, 29, 32)" if scheme == "dark" else "rgb(255, 255, 255)")
    assert seen["keys"] == 6 and seen["film"] == [False, "6", "1", NASTY] and seen["playing"] == "Pause"
    assert float(seen["place"]) == pytest.approx(5.5 - 3 / 180, abs=1e-3) and seen["clicked"] == "2", "the strip has three frames"
    assert seen["larger"] > 1.5 if width > 700 else seen["larger"] == 1
    assert seen["read"] == "frame 10: 20 °" and seen["zoomed"] == ["frame 5", "10"] and seen["whole"] == "frame 0" and seen["open"] >= 5


@needs_browser
def test_a_browser_runs_our_script_alone_and_loads_nothing(tmp_path: Path) -> None:
    """Even if a name were not escaped."""
    probe = tmp_path / "probe.html"
    mark = "document.body.setAttribute"
    injected = f'<img src="x" onerror="{mark}(&quot;data-attribute&quot;, 1)"><script>{mark}("data-foreign", "1")</script>'
    probe.write_text(document("a", f'<h1>{injected}</h1><img src="{(tmp_path / "a.png").as_uri()}">', f'{mark}("data-own", "1")'))
    command = [str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
               probe.as_uri()]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    body = re.search(r"<body[^>]*>", dom)
    assert body and 'data-own="1"' in body[0] and "data-foreign" not in body[0] and "data-attribute" not in body[0], body


def test_parts_of_a_document() -> None:
    assert STYLE in document("a < b", "") and "<title>a &lt; b</title>" in document("a < b", "") and "<script>" not in document("a", "")
    assert 'alt="&quot;x&quot;"' in figure('"x"', b"") and notes(["a & b"]) == '<p class="note">a &amp; b</p>'
    assert table(["", "v"], [["n", "1"]]).count("<th>") == 3 and "http" not in SCRIPT
