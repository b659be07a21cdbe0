"""Other simulators' releases, by name. Each is a module of the same functions:

    scene_files(folder) -> list[Path]           one path a scene, in a stable order
    read(path, folder, split) -> Scene          the scene of one of these paths
    check_footage(scene, folder) -> None        whether its frames are all there, quickly
    images(scene, folder, frames) -> dict       RGB images by frame index

`folder` is the folder of the release that the user names; `Scene.footage` is relative to it. `read`
looks at nothing but the scene's own files, so that scenes can be read in any order and in processes
of their own, and checks the footage. A record that is not as published raises `BadRecord`, which a
caller counts and leaves out, or shows and stops with. Physion does not record its frame rate:
`physion.read` also takes `fps`.
"""

from __future__ import annotations

from types import ModuleType

from data.releases import clevrer, movi_a, physion

RELEASES: dict[str, ModuleType] = {"clevrer": clevrer, "movi_a": movi_a, "physion": physion}
