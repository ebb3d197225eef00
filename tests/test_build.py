"""Packaging: what the extension's zip and the Python package hold, and that the set-up mends itself."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parent.parent
MANIFEST = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
BELONGS = {*"addon core docs tests blender_manifest.toml __init__.py __main__.py LICENSE README.md CHANGELOG.md CONTRIBUTING.md".split(),
           "dev.py", "pyproject.toml"}  # fmt: skip
NOT_SOURCE = shutil.ignore_patterns(".git", ".venv", "wheels", "dist", "out", "build", "__pycache__", ".*_cache", ".gui")


def copied(folder: Path) -> None:
    """A copy of the repository without what lies about in its root."""

    def strangers(where: str, names: list[str]) -> set[str]:
        return {*NOT_SOURCE(where, names), *(name for name in names if Path(where) == ROOT and name not in BELONGS)}

    shutil.copytree(ROOT, folder, ignore=strangers)


@pytest.fixture
def junk_tree(tmp_path: Path) -> Path:
    """A small repository with files that must not be shipped, wherever they lie."""
    wanted = ["blender_manifest.toml", "__init__.py", "__main__.py", "LICENSE", "core/a.py", "core/b/m.toml", "addon/c.py", "addon/p.json"]
    junk = [
        "dev.py",
        "README.md",
        "notes.txt",
        "tests/test_a.py",
        "docs/a.md",
        ".ci/run",
        "dist/x.zip",
        "core/.b.py",
        "core/clip.mp4",
        "core/__pycache__/a.cpython-313.py",
        "core/b/.git/x.py",
        "addon/old.blend1",
        "takes/core/a.py",
        "addon/.cache/x.json",
    ]
    for name in wanted + junk:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


def test_versions_agree() -> None:
    assert MANIFEST["version"] == PROJECT["project"]["version"]


def test_every_platform_and_python_has_its_wheels(dev: ModuleType) -> None:
    for platform in MANIFEST["platforms"]:
        names = [Path(wheel).name for wheel in MANIFEST["wheels"] if dev.serves(wheel, platform)]
        tags = sorted("-".join(name.split("-")[:3]) for name in names)
        assert tags == ["opencv_python_headless-5.0.0.93-cp37", "scipy-1.17.1-cp311", "scipy-1.18.1-cp313", "threadpoolctl-3.8.0-py3"]


def test_setup_and_manifest_name_the_same_versions(dev: ModuleType) -> None:
    shipped = {tuple(Path(wheel).name.split("-")[:3]) for wheel in MANIFEST["wheels"]}
    for (major, minor), requirements in dev.REQUIREMENTS.items():
        scipy = next(line.split("==")[1] for line in requirements if line.startswith("scipy"))
        assert ("scipy", scipy, f"cp{major}{minor}") in shipped
        threadpoolctl = next(line.split("==")[1] for line in requirements if line.startswith("threadpoolctl"))
        assert ("threadpoolctl", threadpoolctl, "py3") in shipped
    assert (*dev.OPENCV.replace("-", "_").split("=="), "cp37") in shipped


def test_packages_of_the_project_are_all_listed() -> None:
    folders = {path.parent for part in ("core", "addon") for path in (ROOT / part).rglob("*.py")}
    bare = [folder.relative_to(ROOT).as_posix() for folder in folders if not (folder / "__init__.py").is_file()]
    assert not bare, f"folders of modules without __init__.py: {bare}"
    packages = {".".join(("tricap", *folder.relative_to(ROOT).parts)) for folder in folders}
    assert packages == set(PROJECT["tool"]["setuptools"]["packages"]), "pyproject.toml, [tool.setuptools] packages"


def test_type_checkers_find_the_types_of_core() -> None:
    """The marker of PEP 561 lies beside the modules and is part of the Python package."""
    assert (ROOT / "core" / "py.typed").is_file()
    assert "py.typed" in PROJECT["tool"]["setuptools"]["package-data"]["tricap.core"]


def test_only_what_belongs_in_it_is_shipped(dev: ModuleType, junk_tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dev, "ROOT", junk_tree)
    assert dev.shipped_files() == [
        "blender_manifest.toml",
        "__init__.py",
        "__main__.py",
        "LICENSE",
        "core/a.py",
        "core/b/m.toml",
        "addon/c.py",
        "addon/p.json",
    ]


def test_zip_holds_the_shipped_files_and_nothing_else(extension_zip: Path, dev: ModuleType) -> None:
    with zipfile.ZipFile(extension_zip) as archive:
        names = archive.namelist()
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert sorted(names) == sorted(dev.shipped_files())
    assert all(name.split("/")[0] in ("core", "addon") or "/" not in name for name in names)
    assert manifest["id"] == "tricap" and manifest["permissions"].keys() == {"files"}


def test_blenders_builder_run_on_the_source_ships_the_same(dev: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("bpy", reason="Blender's builder is in it")
    copied(tmp_path / "copy")
    manifest = {key: value for key, value in MANIFEST.items() if key not in ("wheels", "platforms")}
    text = dev.toml_text({key: value for key, value in manifest.items() if key != "build"})
    text += f"[build]\npaths_exclude_pattern = {manifest['build']['paths_exclude_pattern']}\n"
    (tmp_path / "copy" / "blender_manifest.toml").write_text(text)
    dev.blender_extension("build", "--source-dir", tmp_path / "copy", "--output-filepath", tmp_path / "x.zip")
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        assert sorted(archive.namelist()) == sorted(dev.shipped_files())


@pytest.mark.parametrize("fault", ['tags = ["Nonsense"]', 'tagline = "It ends with a full stop."', 'blender_version_min = "4.5"'])
def test_a_faulty_manifest_is_refused(dev: ModuleType, tmp_path: Path, fault: str) -> None:
    pytest.importorskip("bpy", reason="Blender's validator is in it")
    key = fault.split(" ")[0]
    table = {name: value for name, value in MANIFEST.items() if name not in (key, "wheels", "build")}
    (tmp_path / "__init__.py").write_text("")
    (tmp_path / "blender_manifest.toml").write_text(f"{fault}\n{dev.toml_text(table)}")
    with pytest.raises(SystemExit, match="found a fault"):
        dev.blender_extension("validate", tmp_path)


def test_an_unknown_platform_is_named(dev: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="“beos”.*linux-x64, windows-x64, macos-arm64"):
        dev.build(["beos"], str(tmp_path), with_wheels=False)


def test_another_python_goes_on_with_one_that_blender_exists_for(
    dev: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr(dev, "python_version", lambda: (3, 12))
    monkeypatch.setattr(dev, "fitting_python", lambda: "/usr/bin/python3.13")
    monkeypatch.setattr(dev.subprocess, "run", lambda line: started.append(line) or SimpleNamespace(returncode=7))
    monkeypatch.setattr(sys, "argv", ["dev.py", "test", "-k", "a b"])
    with pytest.raises(SystemExit) as ended:
        dev.change_python()
    assert ended.value.code == 7 and started == [["/usr/bin/python3.13", str(ROOT / "dev.py"), "test", "-k", "a b"]]
    monkeypatch.setattr(dev, "fitting_python", lambda: None)
    dev.change_python()
    assert "no Blender for Python 3.12" in capsys.readouterr().out and not any("bpy" in line for line in dev.requirements())
    with pytest.raises(SystemExit, match="install Python 3.13"):
        dev.blender_extension("build")
    monkeypatch.setattr(dev, "python_version", lambda: (3, 10))
    with pytest.raises(SystemExit, match="needs Python 3.11 or newer"):
        dev.change_python()


@pytest.mark.skipif(os.name == "nt", reason="programs of Unix")
def test_a_python_is_found_on_the_path_and_in_pyenv(dev: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    monkeypatch.setattr(dev, "REQUIREMENTS", {sys.version_info[:2]: []})
    monkeypatch.setenv("PATH", str(tmp_path / "a path"))
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path / "pyenv"))
    assert dev.fitting_python() is None
    for folder in (tmp_path / "a path", tmp_path / "pyenv" / "versions" / f"{name.removeprefix('python')}.1" / "bin"):
        folder.mkdir(parents=True)
        (folder / name).symlink_to(sys.executable)
    assert dev.fitting_python() == str(tmp_path / "a path" / name)
    (tmp_path / "a path" / name).unlink()
    assert "pyenv" in dev.fitting_python()
    monkeypatch.setattr(dev, "REQUIREMENTS", {(3, 99): []})
    assert dev.fitting_python() is None


@pytest.mark.slow
def test_full_zip_holds_the_wheels_of_its_platform(full_extension_zip: Path, dev: ModuleType) -> None:
    with zipfile.ZipFile(full_extension_zip) as archive:
        wheels = {name for name in archive.namelist() if name.startswith("wheels/")}
        assert sorted(set(archive.namelist()) - wheels) == sorted(dev.shipped_files())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert wheels == {wheel.removeprefix("./") for wheel in MANIFEST["wheels"] if dev.serves(wheel, manifest["platforms"][0])}


@pytest.mark.slow
def test_a_set_up_that_was_interrupted_is_mended(dev: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def installs_half() -> None:
        done.append("interrupted")
        raise KeyboardInterrupt

    monkeypatch.setattr(dev, "ROOT", tmp_path)
    monkeypatch.setattr(dev, "install_requirements", installs_half)
    with pytest.raises(KeyboardInterrupt):
        dev.setup()
    (dev.venv_folder() / "half").touch()
    monkeypatch.setattr(dev, "install_requirements", lambda: done.append("complete"))
    dev.setup()
    assert not (dev.venv_folder() / "half").exists(), "the half-made environment was kept"
    dev.setup()
    assert done == ["interrupted", "complete"], "the third call had nothing to do"
    monkeypatch.setitem(dev.REQUIREMENTS, dev.python_version(), ["another"])
    dev.setup()
    assert done == ["interrupted", "complete", "complete"], "other requirements were not installed"
    assert (tmp_path / ".venv" / "src" / "tricap").resolve() == tmp_path


@pytest.mark.slow
def test_it_installs_as_the_package_tricap(tmp_path: Path) -> None:
    copy, target = tmp_path / "an odd-name 1", tmp_path / "target"
    shutil.copytree(ROOT, copy, ignore=NOT_SOURCE)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(target), str(copy)], check=True)
    modules = {path.relative_to(target / "tricap").as_posix() for path in (target / "tricap").rglob("*") if path.suffix in (".py", ".toml")}
    ours = {path.relative_to(ROOT).as_posix() for part in ("core", "addon") for path in (ROOT / part).rglob("*.py")}
    models = {path.relative_to(ROOT).as_posix() for path in (ROOT / "core" / "body" / "models").glob("*.toml")}
    assert modules == ours | models | {"__init__.py", "__main__.py"}
    asked = subprocess.run([target / "bin" / "tricap", "--help"], env={"PYTHONPATH": str(target)}, capture_output=True, text=True)
    assert asked.returncode == 0 and "usage: tricap" in asked.stdout, asked.stderr


def test_tests_wait_for_events_and_not_for_times() -> None:
    """A time is too short on a busy machine: `waiting.py` has what waits for something to happen."""
    waits = re.compile(r"\b(sleep|Timer)\(")
    sources = [path for path in (ROOT / "tests").rglob("*.py") if not {"bench", "gui"} & {*path.parts}]
    found = {path.name for path in sources if waits.search(re.sub(r'"[^"\n]*"', "", path.read_text(encoding="utf-8")))}
    assert found == {"waiting.py"}


def test_every_promise_of_the_security_page_names_tests_that_exist() -> None:
    rows = [line for line in (ROOT / "docs" / "security.md").read_text(encoding="utf-8").splitlines() if line.startswith("| **")]
    assert len(rows) > 10
    for row in rows:
        held = re.findall(r"`(tests/[\w/.]+)`", row)
        assert held or "the same" in row, row
        assert all((ROOT / name).is_file() for name in held), row
    rules = (ROOT / "tests" / "test_architecture.py").read_text(encoding="utf-8")
    assert all(f"def {rule}(" in rules for row in rows for rule in re.findall(r"\(`(\w+)`\)", row))
