"""Presets: what they set, what wins over them, and the seeds that the published method starts from."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from tricap.core.cli.main import main
from tricap.core.foundation.errors import InputError
from tricap.core.run.presets import PRESETS, PUBLISHED
from tricap.core.run.take_run import open_run, settings_of
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take, take_of_text

ASKED = {"method": {"preset": PUBLISHED}}


def test_a_preset_sets_what_nobody_else_sets() -> None:
    """The command wins over take.toml, which wins over the preset, which wins over the defaults."""
    take = {"matching": {"patch_px": 17}, **ASKED}
    found = settings_of(take, {"growing": {"spacing_px": 6}, "matching": {"constraint": "epipolar"}}, "take.toml")
    assert (found["matching"].patch_px, found["matching"].constraint, found["growing"].spacing_px) == (17, "epipolar", 6)
    assert (found["growing"].method, found["fitting"].residual, found["method"].preset) == ("published", "paper", PUBLISHED)
    assert settings_of(ASKED, {"method": {"preset": "default"}}, "take.toml")["growing"].method == "fronts"
    with pytest.raises(InputError, match="choose one of: default, published"):
        settings_of({"method": {"preset": "publisht"}}, {}, "take.toml")


def test_every_value_of_a_preset_differs_from_the_default_or_states_a_figure_of_the_papers() -> None:
    plain, published = settings_of({}, {}, ""), settings_of(ASKED, {}, "")
    same = [
        f"{group}.{name}"
        for group, table in PRESETS[PUBLISHED].items()
        for name in table
        if getattr(plain[group], name) == getattr(published[group], name)
    ]
    assert same == ["matching.patch_px"]


def test_the_preset_is_a_key_of_the_take_and_an_option(plane_take: Path, tmp_path: Path) -> None:
    path = plane_take / "take.toml"
    asked = path.read_text().replace("fps =", 'preset = "published"\nfps =')
    assert take_of_text(asked, path).settings == ASKED | {"growing": {"spacing_px": 6}}  # those of the take
    with pytest.raises(InputError, match="sets `preset` twice"):
        take_of_text(asked + '[settings.method]\npreset = "default"\n', path)
    with open_run(plane_take, tmp_path / "out", ASKED) as run:
        assert run.record["settings"]["method"] == {"preset": PUBLISHED} and "--set method.preset=published" in run.record["repeat"]


@pytest.mark.slow
def test_without_automatic_seeds_the_surface_starts_from_clicks(plane_take: Path, tmp_path: Path, scenes: Any, capsys: Any) -> None:
    """Clicked points of the surface, or else the surface before the clicked joints; the next frame's seeds are points of this one."""
    take = tmp_path / "take"
    shutil.copytree(plane_take, take)
    footage = open_take(read_take(take))
    published = {**PRESETS[PUBLISHED], "growing": {**PRESETS[PUBLISHED]["growing"], "spacing_px": 12}}
    with pytest.raises(InputError, match="this take has none; click joints"):
        scenes.measure(take, tmp_path / "out", published)
    automatic = scenes.measure(plane_take, tmp_path / "plain", {"growing": {"spacing_px": 12}})
    pixels = ", ".join("{} = [{:.2f}, {:.2f}]".format(c.name, *c.project([0.0, 0.0, scenes.depth_m])) for c in footage.rig.cameras)
    text = (take / "take.toml").read_text()
    (take / "take.toml").write_text(text + f"[seeds]\nframe = 0\nsurface = [{{ {pixels} }}]\n")
    one_seed = scenes.measure(take, tmp_path / "seeded", published)
    assert all(len(a.cloud.xyz_m) > 0.7 * len(b.cloud.xyz_m) for a, b in zip(one_seed, automatic))
    assert main(["seeds", str(take), "--preset", "published"]) == 0 and "Frame 0: 1 surface seeds" in capsys.readouterr().out
    (take / "take.toml").write_text(text + f"[seeds]\nframe = 0\n[seeds.joints]\n'elbow.R' = {{ {pixels} }}\n")
    assert main(["seeds", str(take), "--preset", "published"]) == 0 and "Frame 0: 1 surface seeds" in capsys.readouterr().out
    assert main(["measure", str(take), "--out", str(tmp_path / "late"), "--preset", "published", "--frames", "1:3"]) == 2
    assert "starts from the clicks in frame 0: measure that frame, too" in capsys.readouterr().err
