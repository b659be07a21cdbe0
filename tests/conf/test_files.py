"""Files are written atomically."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dynapix.conf.files import write_bytes, write_text


@pytest.mark.parametrize(("write", "content"), [(write_bytes, b"new"), (write_text, "new")])
def test_failed_write_leaves_the_earlier_file(
    write: Callable, content: bytes | str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "part.npz"
    path.write_text("earlier")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: .*part\.npz"):
        write(path, content)
    assert [p.read_text() for p in tmp_path.iterdir()] == ["earlier"]
