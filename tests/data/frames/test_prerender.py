"""Frames that are rendered in advance."""

from __future__ import annotations

import json
import shutil
import threading
import time
from pathlib import Path

import pytest

from data.frames import prerender
from data.frames.frame_cache import frames_path
from data.frames.prerender import FRAMES_RECORD, frames_to_render, prerender_frames
from data.parallel import Workers
from data.store import FRAMES_FOLDER, Store, open_store


@pytest.mark.parametrize("workers", [1, 2])
def test_a_lower_limit_deletes_archives_of_an_earlier_build(
    micro_store: Store, tmp_path: Path, workers: int
) -> None:
    store = open_store(shutil.copytree(micro_store.folder, tmp_path / micro_store.folder.name))
    scenes = frames_to_render(store, "named")

    def read_sizes() -> list[int]:
        paths = [frames_path(store.folder, scene) for scene in scenes]
        return [path.stat().st_size for path in paths if path.exists()]

    limit = sum(read_sizes()) / 2
    prerender_frames(store, "named", limit / 1e9, Workers(workers))
    record = json.loads((store.folder / FRAMES_FOLDER / FRAMES_RECORD).read_text())
    sizes = read_sizes()
    assert 0 < sum(sizes) <= limit
    assert (record["bytes"], record["scenes"]) == (sum(sizes), len(sizes))


def test_jobs_that_waited_for_one_build_render_its_frames_once(
    micro_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(micro_store.folder, tmp_path / micro_store.folder.name)
    shutil.rmtree(folder / FRAMES_FOLDER)
    store, rendered = open_store(folder), []

    def render(*_: object) -> dict[str, float]:
        rendered.append(1)
        time.sleep(0.5)
        return {"scenes": 0, "bytes": 0.0}

    monkeypatch.setattr(prerender, "_render_scenes", render)
    jobs = [
        threading.Thread(target=prerender_frames, args=(store, "named", None, Workers(1)))
        for _ in range(3)
    ]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join()
    assert len(rendered) == 1
