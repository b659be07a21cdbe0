"""Frames that are rendered in advance."""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path

import pytest

from dynapix.data.frames import prerender
from dynapix.data.frames.prerender import prerender_frames
from dynapix.data.parallel import Workers
from dynapix.data.store import FRAMES_FOLDER, Store, open_store


def test_jobs_that_waited_for_one_build_render_its_frames_once(
    micro_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(micro_store.folder, tmp_path / micro_store.folder.name)
    shutil.rmtree(folder / FRAMES_FOLDER)
    store, rendered = open_store(folder), []

    def render(*_: object) -> dict[str, int]:
        rendered.append(1)
        time.sleep(0.5)
        return {"scenes": 0, "bytes": 0}

    monkeypatch.setattr(prerender, "_render_scenes", render)
    jobs = [
        threading.Thread(target=prerender_frames, args=(store, "named", Workers(1)))
        for _ in range(3)
    ]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join()
    assert len(rendered) == 1
