"""The published and the default method side by side: the measures, the page, and what is refused."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tricap.core.cli.main import main
from tricap.core.report.comparison import DEFAULT, HIGHER, LOWER, PUBLISHED, Measure, comparison_page, written
from tricap.core.report.pictures import png
from tricap.core.run.compare import NEIGHBOURS, surface_noise_m


@pytest.mark.parametrize("sigma_m", [0.0002, 0.001])
def test_noise_of_a_point_on_a_round_limb(sigma_m: float) -> None:
    """Independent noise along the normals of a limb of 45 mm, 4 mm apart: its sigma, not the limb's shape, is measured."""
    angle, z = np.meshgrid(np.arange(-0.8, 0.8, 0.09), np.arange(0, 0.2, 0.004))
    radius = 0.045 + np.random.default_rng(3).normal(0, sigma_m, angle.shape)
    xyz = np.stack([radius * np.sin(angle), -radius * np.cos(angle), z], axis=-1).reshape(-1, 3)
    assert surface_noise_m(xyz) == pytest.approx(sigma_m, rel=0.12)  # ± 4 % by the number of points; the limb's shape adds 0.00002 m
    assert np.isnan(surface_noise_m(xyz[:NEIGHBOURS]))


def test_the_better_value() -> None:
    """By direction; none within 2 %, without a value, or where no value is better than another."""

    def winner(a: float, b: float, better: str) -> str:
        return Measure(name="", unit="", published=a, default=b, better=better).winner

    assert (winner(1.0, 2.0, HIGHER), winner(1.0, 2.0, LOWER)) == (DEFAULT, PUBLISHED)
    assert [winner(*v) for v in ((1.0, 1.01, HIGHER), (np.nan, 1.0, LOWER), (1.0, 2.0, ""), (0.0, 0.0, LOWER))] == [""] * 4


def test_names_are_text_in_the_page(tmp_path: Path) -> None:
    page = comparison_page("<script>kick", [Measure(name="a < b", unit="<i>", published=1.0, default=np.nan)], [tmp_path, tmp_path])
    assert "<script>kick" not in page and "&lt;script&gt;kick" in page and "a &lt; b" in page and "&lt;i&gt;" in page and "–" in page


def test_the_page_groups_measures_and_describes_pictures(tmp_path: Path) -> None:
    """A measure that neither has is left out; pictures of the same name are a row, with what they show in words."""
    for method in (PUBLISHED, DEFAULT):
        (tmp_path / method / "report").mkdir(parents=True)
        for name in ("body_0007_C.png", "trails_removed.png", "layers.png"):
            (tmp_path / method / "report" / name).write_bytes(png(np.zeros((4, 4, 3), np.uint8)))
    shared = dict(unit="mm", better=LOWER)
    measures = [
        Measure(name="a", group="Surface", published=2.0, default=0.00002, **shared),
        Measure(name="b", group="Surface", published=1.0, default=1.0, **shared),
        Measure(name="c", group="Body", published=np.nan, default=np.nan, **shared),
    ]
    page = comparison_page("kick", measures, [tmp_path / method for method in (PUBLISHED, DEFAULT)])
    assert page.count(">Surface</span>") == 1 and "Body</span>" not in page and "&lt; 0.001" in page
    assert "default: the fitted body, frame 7, view C" in page and "published: the layers of the body in its rest pose" in page
    assert "removed by the filters" in page and page.count("<img") == 6


def test_values_are_short() -> None:
    assert [written(v) for v in (np.nan, 0.0, 12_345.6, 98.163, 0.25, 100.0)] == ["–", "0", "12,346", "98.2", "0.250", "100"]


@pytest.mark.slow
def test_both_methods_on_a_take(plane_take: Path, tmp_path: Path, scenes: Any, capsys: Any) -> None:
    """Two runs in folders of their own, one page and one table; a second call computes nothing."""
    take, out = Path(shutil.copytree(plane_take, tmp_path / "take")), tmp_path / "out"
    pixels = ", ".join(
        "{} = [{:.1f}, {:.1f}]".format(c.name, *c.project([0.0, 0.0, scenes.depth_m])) for c in scenes.three_cameras().cameras
    )
    (take / "take.toml").write_text((take / "take.toml").read_text() + f"[seeds]\nsurface = [{{ {pixels} }}]\n")
    command = ["compare", str(take), "--out", str(out), "--frames", "0:2", "--json", "--quiet"]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row for row in first}
    assert rows["points a frame"]["published"] > 100 and rows["reported sigma of a joint (median)"]["default"] is None
    for method, scan in ((PUBLISHED, "published"), (DEFAULT, "fronts")):
        run = json.loads((out / method / "run.json").read_text())
        assert run["settings"]["method"]["preset"] == method and run["settings"]["growing"]["method"] == scan
    assert json.loads((out / "compare.json").read_text())["measures"] == first
    page = (out / "compare.html").read_text()
    assert page.count("<img") == 2 * len(list((out / PUBLISHED / "report").glob("*.png"))) and "://" not in page
    before = (out / DEFAULT / "run.json").stat().st_mtime_ns
    assert main(command) == 0 and (out / DEFAULT / "run.json").stat().st_mtime_ns == before
    assert main([*command, "--set", "method.preset=published"]) == 2 and "leave out --preset" in capsys.readouterr().err
    assert main(["compare", str(take), "--out", str(take)]) == 2 and "is itself a take" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_method_s_folder_that_leads_elsewhere_is_refused(plane_take: Path, tmp_path: Path, capsys: Any) -> None:
    for method in (PUBLISHED, DEFAULT):
        (tmp_path / method / "elsewhere").mkdir(parents=True)
        (tmp_path / method / "out").mkdir()
        (tmp_path / method / "out" / method).symlink_to(tmp_path / method / "elsewhere")
        assert main(["compare", str(plane_take), "--out", str(tmp_path / method / "out"), "--frames", "0:1", "--quiet"]) == 2
        assert "is a link to a place outside" in capsys.readouterr().err and not any((tmp_path / method / "elsewhere").iterdir())
