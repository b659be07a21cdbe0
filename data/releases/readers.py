"""Readers of other simulators' releases, by simulator. Each module provides four functions:

    list_scenes(folder) -> list[Path]           one path a scene, in a stable order
    read_scene(path, folder, split) -> Scene    the scene at one of these paths
    check_frames(scene, folder) -> None         checks that every frame exists, without decoding
    load_images(scene, folder, frames) -> dict  RGB images by frame index

`folder` is the release's folder; `Scene.footage` is relative to it. `read_scene` reads only the
scene's own files and checks that its frames exist, so scenes can be read in any order and in
separate processes. A record that does not have the published layout raises `RecordError`.
Physion's trials do not record their frame rate: `physion.read_scene` also takes `fps`.
"""

from __future__ import annotations

from types import ModuleType

from data.releases import clevrer, movi_a, physion

READERS: dict[str, ModuleType] = {"clevrer": clevrer, "movi_a": movi_a, "physion": physion}
