"""The folder in which tests run the toy command."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder that contains the toy command."""
    shutil.copy(Path(__file__).with_name("toy.py"), tmp_path)
    return tmp_path
