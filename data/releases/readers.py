"""Readers of other simulators' releases: one module per simulator, with three functions each.

    list_scenes(folder) -> list[Path]           one path per scene, in a stable order
    read_scene(path, folder, split) -> Scene    the scene at one of these paths
    load_images(scene, folder, frames) -> dict  RGB images by frame index

`folder` is the release's folder; `Scene.footage` is relative to it. `list_scenes` raises UserError
for a folder without scenes, and for a scene that occurs twice. `read_scene` reads only the scene's
own files and checks that its frames exist, so scenes can be read in any order and in separate
processes. `read_scene` and `load_images` raise `RecordError` for a record that is damaged or does
not have the published layout. `physion.read_scene` also has the argument `fps`, because Physion's
trials do not record their frame rate.
"""

from __future__ import annotations

from types import ModuleType

from data.releases import clevrer, movi_a, physion

READERS: dict[str, ModuleType] = {"clevrer": clevrer, "movi_a": movi_a, "physion": physion}
