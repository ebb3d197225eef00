"""What several tests need: the recordings kept beside the repository, and a real Blender with the extension enabled from source."""

import hashlib
import importlib.util
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
TAKES = ROOT.parent / "shared" / "takes"
EXTENSION = "bl_ext.user_default.tricap"
PLATFORM = {"linux": "linux-x64", "win32": "windows-x64", "darwin": "macos-arm64"}[sys.platform]
# Blender looks for its user's files when bpy is first imported, whichever test does that: never in a real profile.
PROFILE = Path(tempfile.mkdtemp(prefix="tricap-profile-"))
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in the command and the add-on: with more threads the last digits differ
os.environ["BLENDER_USER_RESOURCES"] = str(PROFILE)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shuffle", type=int, metavar="SEED", help="the files, and the tests in each of them, in a random order")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The order of `--shuffle`. Tests of a file stay together: they share what is costly to make."""
    seed = config.getoption("--shuffle")
    if seed is not None:
        places = {item.path: hashlib.sha256(f"{seed} {item.path.name}".encode()).digest() for item in items}
        random.Random(seed).shuffle(items)
        items.sort(key=lambda item: places[item.path])


_exit_code: list[int] = []


def pytest_sessionfinish(exitstatus: int) -> None:
    _exit_code.append(int(exitstatus))


@pytest.hookimpl(trylast=True)
def pytest_unconfigure() -> None:
    """The last thing that pytest does. Blender 4.5 as a module can hang when the interpreter ends, whatever was unregistered before."""
    shutil.rmtree(PROFILE, ignore_errors=True)
    bpy = sys.modules.get("bpy")
    if bpy is not None and bpy.app.version < (5, 0) and _exit_code:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_exit_code[0])


@pytest.fixture(scope="session")
def dev() -> ModuleType:
    """dev.py as a module."""
    spec = importlib.util.spec_from_file_location("tricap_dev", ROOT / "dev.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def needs_blender() -> None:
    """Skip what needs bpy, also its tools, in a Python without it."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed for this Python")


@pytest.fixture(scope="session")
def extension_zip(dev: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The extension without its wheels: scipy and OpenCV are beside bpy already."""
    needs_blender()
    (made,) = dev.build([PLATFORM], str(tmp_path_factory.mktemp("zip")), with_wheels=False)
    return Path(made)


@pytest.fixture(scope="session")
def full_extension_zip(dev: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The extension as users get it, with its wheels (downloaded once, about 130 MB)."""
    needs_blender()
    (made,) = dev.build([PLATFORM], str(tmp_path_factory.mktemp("full_zip")), with_wheels=True)
    return Path(made)


@pytest.fixture(scope="session")
def shared_takes() -> Path:
    """The folder of recordings that is not part of the repository."""
    if not TAKES.is_dir():
        pytest.skip("the recordings are not on this machine (no folder shared/takes beside the repository)")
    return TAKES


@pytest.fixture(scope="session")
def blender(dev: ModuleType) -> Iterator[ModuleType]:
    """bpy with the extension enabled as `bl_ext.user_default.tricap`, from this source; disabled at the end.

    Blender 4.5 as a module hangs at the interpreter's end when a class is still registered; hence the orderly end.
    """
    needs_blender()
    repository = PROFILE / "extensions" / "user_default"
    repository.mkdir(parents=True, exist_ok=True)
    dev.link_folder(repository / "tricap", ROOT)
    import addon_utils
    import bpy

    addon_utils.extensions_refresh()
    assert addon_utils.enable(EXTENSION, default_set=True) is not None, f"{EXTENSION} could not be enabled (see above)"
    yield bpy
    addon_utils.disable(EXTENSION, default_set=True)
