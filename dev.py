"""Set-up, demo, tests, packages: `python3 dev.py --help`. The standard library is all it needs.

The Python that runs this file decides which Blender is installed beside the code (as the `bpy` module):
Python 3.11 gets Blender 4.5 LTS, Python 3.13 gets Blender 5.2 LTS, each in its own .venv/pyX.Y. Any other Python goes on with one of
these two, if the machine has one. Otherwise everything but Blender runs in an environment of its own: Python 3.11 or newer will do.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent
TOOLS = ["pytest>=9", "pytest-xdist>=3.8", "ruff==0.17.6", "mypy", "setuptools>=77", "c3d>=0.6", "dask[distributed]>=2024.8"]
REQUIREMENTS = {
    (3, 11): ["bpy==4.5.15", "numpy>=1.26,<2", "scipy==1.17.1", "threadpoolctl==3.8.0", *TOOLS],
    (3, 13): ["bpy==5.2.3", "numpy>=2.2,<3", "scipy==1.18.1", "threadpoolctl==3.8.0", *TOOLS],
}
OPENCV = "opencv-python-headless==5.0.0.93"  # as shipped; it asks pip for numpy 2, and works with the numpy 1 of Blender 4.5
WITHOUT_BLENDER = ["numpy>=2.2,<3", "scipy>=1.18", "threadpoolctl==3.8.0", *TOOLS]  # of any other Python
OLDEST = (3, 11)
BLENDER = {(3, 11): "4.5 LTS", (3, 13): "5.2 LTS"}
WINDOWS = os.name == "nt"
STAMP = "tricap-setup.txt"
LONG_BENCHES = ("resume", "surface", "clip")  # run when they are named only
# What an extension consists of; everything else in the repository is for developers.
SHIPPED_FILES = ("blender_manifest.toml", "__init__.py", "__main__.py", "LICENSE")
SHIPPED_FOLDERS = {"core": (".py", ".toml", ".csv"), "addon": (".py", ".toml", ".json", ".zip")}
ANY = "any"  # the platform of a wheel in Python alone
PLATFORM_OF_TAG = {"x86_64": "linux-x64", "amd64": "windows-x64", "arm64": "macos-arm64", ANY: ANY}  # how a wheel's name ends


# ---- the environment -------------------------------------------------------------------------------------------------


def python_version() -> tuple[int, int]:
    """The running Python's (major, minor)."""
    return sys.version_info[:2]


def has_blender() -> bool:
    """Whether there is a Blender as a module for the running Python."""
    return python_version() in REQUIREMENTS


def requirements() -> list[str]:
    """What is installed for the running Python."""
    return REQUIREMENTS.get(python_version(), WITHOUT_BLENDER)


def change_python() -> None:
    """Go on with a Python that Blender exists for, if this is none and the machine has one; end where this one is too old."""
    if has_blender():
        return
    other = fitting_python()
    this = "Python {}.{}".format(*python_version())
    if other is not None:
        say(f"Going on with {other}, for there is no Blender for {this}.")
        sys.exit(subprocess.run([other, str(ROOT / "dev.py"), *sys.argv[1:]]).returncode)
    if python_version() < OLDEST:
        sys.exit(f"Tricap needs Python 3.11 or newer, best 3.13, for which there is a Blender; this is {this}. Install that.")
    say(f"There is no Blender for {this}: all runs but what needs Blender. For that, install Python 3.13 or 3.11, then run this again.")


def fitting_python() -> str | None:
    """A program of this machine that is a Python which Blender exists for: on the path, of pyenv, or of the Windows launcher."""
    for major, minor in sorted(REQUIREMENTS, reverse=True):
        name = f"python{major}.{minor}"
        pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
        tried = [shutil.which(name), *sorted(map(str, pyenv.glob(f"{major}.{minor}.*/bin/{name}")))]
        if WINDOWS and shutil.which("py"):
            line = ["py", f"-{major}.{minor}", "-c", "import sys; print(sys.executable)"]
            tried.append(subprocess.run(line, capture_output=True, text=True).stdout.strip())
        for program in filter(None, tried):
            if _is_python(program, (major, minor)):
                return program
    return None


def _is_python(program: str, version: tuple[int, int]) -> bool:
    """Whether a program runs, is Python of that version, and can make environments (Debian's may lack that part)."""
    code = f"import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != {version!r})"
    try:
        return subprocess.run([program, "-c", code], capture_output=True).returncode == 0
    except OSError:
        return False


def venv_folder() -> Path:
    """The virtual environment of the running Python's version."""
    return ROOT / ".venv" / "py{}.{}".format(*python_version())


def venv_program(name: str) -> Path:
    """A program of that environment, e.g. "python" or "tricap"."""
    return venv_folder() / ("Scripts" if WINDOWS else "bin") / (name + (".exe" if WINDOWS else ""))


def site_packages() -> Path:
    """Where that environment keeps its packages."""
    return venv_folder() / ("Lib/site-packages" if WINDOWS else "lib/python{}.{}/site-packages".format(*python_version()))


def requirements_digest() -> str:
    """Changes when the environment has to be made or mended: other requirements, a moved folder."""
    text = "\n".join([str(ROOT), *requirements(), OPENCV])
    return hashlib.sha256(text.encode()).hexdigest()


def setup() -> None:
    """Make the environment unless it is there and complete. The stamp is written last: without it everything is made anew."""
    stamp = venv_folder() / STAMP
    if stamp.is_file() and stamp.read_text() == requirements_digest() and venv_program("python").exists():
        link_source()
        return
    if not stamp.is_file() or not venv_program("python").exists():
        make_venv()
    stamp.unlink(missing_ok=True)
    install_requirements()
    link_source()
    stamp.write_text(requirements_digest())


def make_venv() -> None:
    """An empty environment; one that was left half made is removed."""
    shutil.rmtree(venv_folder(), ignore_errors=True)
    made = subprocess.run([sys.executable, "-m", "venv", str(venv_folder())], capture_output=True, text=True)
    if made.returncode:
        sys.exit(
            f"Python could not make {venv_folder()}: {(made.stdout + made.stderr).strip()}\n"
            "On Debian and Ubuntu, install the package python3-venv (python3.11-venv, python3.13-venv) and run this again."
        )


def install_requirements() -> None:
    """pip install, in one command so that numpy stays the one that Blender was built for; OpenCV after it, without asking for another."""
    blender = f"Blender {BLENDER[python_version()]} (as a Python module, about 400 MB) and " if has_blender() else ""
    say(f"Installing {blender}the tools into {venv_folder()}; about a minute.")
    pip = [str(venv_program("python")), "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-input"]
    if any(subprocess.run([*pip, *what], cwd=ROOT).returncode for what in (requirements(), ["--no-deps", OPENCV])):
        sys.exit("pip could not install the packages (see above). Check the network and the free space (2 GB), then run this again.")


def link_source() -> None:
    """Make the repository importable as `tricap`, whatever its folder is called, and install the `tricap` command.

    A link in a folder on the path is seen by Python, pytest and mypy alike; mypy does not see the import hook that an
    editable install of a package whose root is the project's root would make.
    """
    source = ROOT / ".venv" / "src"
    source.mkdir(parents=True, exist_ok=True)
    link_folder(source / "tricap", ROOT)
    write_if_changed(site_packages() / "tricap.pth", f"{source}\n")
    if WINDOWS:
        write_if_changed(venv_folder() / "Scripts" / "tricap.cmd", '@"%~dp0python.exe" -P -m tricap %*\n')
    else:
        script = f'#!/bin/sh\nexec {shlex.quote(str(venv_program("python")))} -P -m tricap "$@"\n'
        write_if_changed(venv_program("tricap"), script)
        venv_program("tricap").chmod(0o755)


def link_folder(link: Path, target: Path) -> None:
    """`link` becomes a link to the folder `target`: a symbolic link, or on Windows a junction (which needs no special right)."""
    if os.path.lexists(link):
        if link.resolve() == target.resolve():
            return
        os.rmdir(link) if WINDOWS else os.unlink(link)
    if WINDOWS:
        import _winapi

        _winapi.CreateJunction(str(target), str(link))  # type: ignore[attr-defined]
    else:
        link.symlink_to(target, target_is_directory=True)


def write_if_changed(path: Path, text: str) -> None:
    """Write a small text file only when its content is new."""
    if not path.is_file() or path.read_text() != text:
        path.write_text(text)


# ---- the commands ----------------------------------------------------------------------------------------------------


def say(sentence: str) -> None:
    """Tell the user, at once (the programs that we start write to the same terminal)."""
    print(sentence, flush=True)


def run(*command: object, folder: Path = ROOT, **variables: str) -> int:
    """Run a program of the environment in the repository or another folder, with these variables of the environment; its exit code.

    One thread for OpenBLAS: numpy 1.26's (Blender 4.5) waits busily in every small matrix, beside the threads that match.
    """
    environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ, **variables}
    return subprocess.run([str(part) for part in command], cwd=folder, env=environment).returncode


def lint() -> int:
    """Style and format of everything, types of the core."""
    python = venv_program("python")
    checks = (["ruff", "check", "."], ["ruff", "format", "--check", "."])
    styled = max(run(python, "-P", "-m", *check) for check in checks)
    types = ["mypy", "--config-file", ROOT / "pyproject.toml", "--cache-dir", ROOT / ".mypy_cache"]
    return max(styled, run(python, "-P", "-m", *types, folder=venv_folder()))  # a numpy.py of the folder it runs in would be numpy to mypy


def demo(out: str) -> int:
    """A sample recording with known truth, everything run on it, and how close it came."""
    return run(venv_program("python"), "-m", "tricap", "demo", "--out", Path(out).absolute())


def sample() -> int:
    """The archive that *Load Sample* opens, made anew; needed when a test says that it is out of date."""
    made = """
import pathlib, sys
from tricap.core.run import pipeline
from tricap.core.synthetic import sample
archive, folder = map(pathlib.Path, sys.argv[1:])
sample.make_recording(folder)
pipeline.run(folder, folder / sample.RESULTS)
sample.pack(archive, folder)
"""
    with tempfile.TemporaryDirectory() as folder:
        return run(venv_program("python"), "-P", "-c", made, ROOT / "addon" / "sample.zip", Path(folder) / "sample")


def test(everything: bool, pytest_arguments: list[str]) -> int:
    """Lint, types and tests; without `--all` the slow tests are left out. A process per core, each file in one of them (`-n0`: in none).

    Lint and types, on one core, run beside the tests and are shown after them. The tests start hundreds of Pythons, which without
    bytecode would each compile the whole code; therefore it is written even where the user's variables forbid it.
    `-P`: a file of the repository's root that happens to be called numpy.py is no module.
    """
    selection = [] if everything or "-m" in pytest_arguments else ["-m", "not slow"]
    processes = ["-n", str(min(os.cpu_count() or 1, 4)), "--dist", "loadfile"]
    with subprocess.Popen([sys.executable, str(ROOT / "dev.py"), "lint"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as linting:
        tested = run(venv_program("python"), "-P", "-m", "pytest", *processes, *selection, *pytest_arguments, PYTHONDONTWRITEBYTECODE="")
        say(linting.communicate()[0].decode(errors="replace").strip())
    linted = linting.returncode
    say(f"lint and types: {'failed' if linted else 'passed'}; tests: {'failed' if tested else 'passed'}")
    return linted or tested


def bench(stage: str | None, json_path: str | None, save: bool) -> int:
    """Run tests/bench/<stage>.py, or all but the long ones; each takes `--json FILE`, and their results become one file and one table."""
    found = sorted((ROOT / "tests" / "bench").glob("[!_]*.py"))
    stages = [path for path in found if path.stem == stage or (stage is None and path.stem not in LONG_BENCHES)]
    if not stages:
        sys.exit(f"There is no benchmark{f' named “{stage}”' if stage else ' yet'} in tests/bench.")
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for path in stages:
            part = Path(folder) / f"{path.stem}.json"
            if code := run(venv_program("python"), path, "--json", part):
                return code
            results[path.stem] = json.loads(part.read_text(encoding="utf-8"))
        every = Path(json_path or Path(folder) / "all.json")
        every.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        say("\nAll figures beside their peers and bounds, and beside the last committed ones (tests/bench/baseline.json):")
        return run(venv_program("python"), ROOT / "tests" / "bench" / "_table.py", every, *(["--save"] if save else []))


# ---- the extension ---------------------------------------------------------------------------------------------------


def build(platforms: list[str] | None, out: str, with_wheels: bool) -> list[Path]:
    """One validated extension zip per platform, made by Blender's own extension tool. Returns their paths."""
    import tomllib

    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    zips = []
    for platform in platforms or manifest["platforms"]:
        if platform not in manifest["platforms"]:
            sys.exit(f"There is no platform “{platform}” in blender_manifest.toml; choose from {', '.join(manifest['platforms'])}.")
        wheels = [name for name in manifest["wheels"] if serves(name, platform)] if with_wheels else []
        for wheel in wheels:
            fetch_wheel(ROOT / wheel)
        zips.append(build_one(manifest, platform, wheels, Path(out).absolute()))
    return zips


def serves(wheel: str, platform: str) -> bool:
    """Whether a wheel is for that Blender platform, from its file name."""
    return next(of for tag, of in PLATFORM_OF_TAG.items() if wheel.endswith(f"{tag}.whl")) in (platform, ANY)


def fetch_wheel(path: Path) -> None:
    """Download one wheel from the Python Package Index, unless it is there. Its file name says all that pip has to know."""
    if path.is_file():
        return
    name, version, python_tag, abi, platform_tags = path.stem.split("-")
    say(f"Downloading {path.name}")
    pip = [str(venv_program("python")), "-m", "pip", "download", "-q", "--disable-pip-version-check", "--no-deps", "--only-binary=:all:"]
    # A stable-ABI wheel names the oldest Python it serves; pip wants one that it has heard of.
    target = ["--implementation", "cp", "--abi", abi, "--python-version", "311" if abi == "abi3" else python_tag.removeprefix("cp")]
    for tag in platform_tags.split("."):
        target += ["--platform", tag]
    if platform_tags == ANY:
        target = []
    if subprocess.run([*pip, *target, "--dest", str(path.parent), f"{name}=={version}"]).returncode or not path.is_file():
        sys.exit(f"pip could not download {path.name} (see above). Check the network, then run this again.")


def build_one(manifest: dict[str, object], platform: str, wheels: list[str], out: Path) -> Path:
    """Pack and validate the extension for one platform, from a copy that holds only what belongs in it."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        staging, packed = Path(folder) / "tricap", Path(folder) / "packed"
        packed.mkdir()
        for name in shipped_files():
            (staging / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, staging / name)
        for wheel in wheels:
            (staging / "wheels").mkdir(exist_ok=True)
            link_or_copy(ROOT / wheel, staging / wheel)
        own = {**manifest, "platforms": [platform], "wheels": wheels}
        own = {key: value for key, value in own.items() if key != "build" and value}
        (staging / "blender_manifest.toml").write_text(toml_text(own), encoding="utf-8")
        blender_extension("build", "--source-dir", staging, "--output-dir", packed, "--split-platforms")
        (made,) = packed.glob("*.zip")
        blender_extension("validate", made)
        shutil.move(str(made), str(out / made.name))
    say(f"{out / made.name}  {(out / made.name).stat().st_size / 1e6:.1f} MB")
    return out / made.name


def shipped_files() -> list[str]:
    """The files of the extension, relative to the repository, in a fixed order."""
    names = list(SHIPPED_FILES)
    for folder, endings in SHIPPED_FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*")):
            relative = path.relative_to(ROOT)
            if path.is_file() and path.suffix in endings and not any(part.startswith((".", "__pycache__")) for part in relative.parts):
                names.append(relative.as_posix())
    return names


def toml_text(table: dict[str, object]) -> str:
    """TOML of a flat table and the tables in it; a JSON string or list of strings is one of TOML too."""
    values = [f"{key} = {json.dumps(value)}" for key, value in table.items() if not isinstance(value, dict)]
    inner = [f"\n[{key}]\n{toml_text(value)}" for key, value in table.items() if isinstance(value, dict)]
    return "\n".join([*values, *inner]) + "\n"


def link_or_copy(source: Path, target: Path) -> None:
    """A hard link where the file system allows it (wheels are large), else a copy."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def blender_extension(command: str, *arguments: object) -> None:
    """Run Blender's extension tool (the one inside the bpy module) with the tags that Blender allows."""
    if not has_blender():
        sys.exit("Only Blender can pack its extensions: install Python 3.13 or 3.11, for which it exists as a module, and run this again.")
    (scripts,) = site_packages().glob("bpy/*/scripts")
    tool = scripts / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    tags = scripts / "modules" / "_bpy_internal" / "extensions" / "tags.py"
    line = [str(venv_program("python")), str(tool), command, "--valid-tags", str(tags), *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"Blender's extension tool found a fault ({command}):\n{done.stdout}{done.stderr}")


def gui_test(out: str, scripts: list[str], install: bool, module: bool) -> int:
    """Tricap in a true Blender window (tests/gui): Debian's, or that of the module for this Python (3.11: Blender 4.5, 3.13: 5.2)."""
    with tempfile.TemporaryDirectory() as folder:
        package = build_for_window(Path(folder), module)
        more = [*(["--install"] if install else []), *(["--module"] if module else [])]
        said = ["--package", package, "--out", Path(out).absolute(), *more, *scripts]
        return run(venv_program("python"), ROOT / "tests" / "gui" / "run.py", *said)


def build_for_window(out: Path, module: bool) -> Path:
    """The extension for Linux. Debian's Blender has Python 3.14 and a scipy of its own: without `module`, only wheels for any Python."""
    import tomllib

    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    wheels = [name for name in manifest["wheels"] if serves(name, "linux-x64") and (module or "-abi3-" in name or "-none-" in name)]
    for wheel in wheels:
        fetch_wheel(ROOT / wheel)
    return build_one(manifest, "linux-x64", wheels, out)


# ---- the command line ------------------------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    top = argparse.ArgumentParser(prog="dev.py", description="Work on Tricap: set-up, demo, tests, packages.")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    commands.add_parser("setup", help="make .venv for this Python and install what is needed (the other commands do it too)")
    part = commands.add_parser("demo", help="make a sample recording, run everything on it, say how close the result is")
    part.add_argument("--out", default=str(ROOT / "out" / "demo"), help="folder of the results (default: out/demo)")
    commands.add_parser("sample", help="make addon/sample.zip anew, which Load Sample opens")
    part = commands.add_parser("test", allow_abbrev=False, help="lint, types and tests; further arguments go to pytest")
    part.add_argument("--all", action="store_true", help="the slow tests too")
    part = commands.add_parser("build", help="make the extension, one validated zip per platform")
    part.add_argument("--platform", action="append", help="only this platform, e.g. linux-x64 (may be repeated)")
    part.add_argument("--out", default=str(ROOT / "dist"), help="folder of the zips (default: dist)")
    part.add_argument("--without-wheels", action="store_true", help="for a Blender that has scipy and OpenCV already")
    part = commands.add_parser("bench", help="performance and accuracy, stage by stage")
    part.add_argument("stage", nargs="?", help="only this stage")
    part.add_argument("--json", metavar="FILE", help="write the results to FILE")
    part.add_argument("--save", action="store_true", help="make these results the baseline that later ones are compared with")
    part = commands.add_parser("gui-test", help="the workflow in a true Blender window (set up in .gui; Linux, as root)")
    part.add_argument("--out", default=str(ROOT / "out" / "gui"), help="folder of pictures and logs (default: out/gui)")
    part.add_argument("--install", action="store_true", help="install debootstrap where it is missing (apt-get)")
    part.add_argument("--module", action="store_true", help="the window of Blender's module for this Python: 4.5 LTS under Python 3.11")
    part.add_argument("script", nargs="*", help="only these scripts")
    commands.add_parser("lint", help="style and types")
    return top


def main() -> int:
    """Run one command; its exit code."""
    options, rest = parser().parse_known_args()
    if rest and options.command != "test":
        parser().error(f"unknown arguments: {' '.join(rest)}")
    change_python()
    setup()
    if options.command == "demo":
        return demo(options.out)
    if options.command == "sample":
        return sample()
    if options.command == "test":
        return test(options.all, rest)
    if options.command == "build":
        build(options.platform, options.out, not options.without_wheels)
    if options.command == "bench":
        return bench(options.stage, options.json, options.save)
    if options.command == "gui-test":
        return gui_test(options.out, options.script, options.install, options.module)
    return lint() if options.command == "lint" else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
