"""Rendered surfaces with exact truth, shared with the benchmark."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def surfaces() -> ModuleType:
    """tests/bench/_surfaces.py as a module."""
    path = Path(__file__).resolve().parents[2] / "bench" / "_surfaces.py"
    spec = importlib.util.spec_from_file_location("tricap_surfaces", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
