"""Writes small videos with the tracks of their objects."""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.data.sources.pictures import write_video

SIZE = 96, 64
NAMES = {1: {"noun": "ball", "color": "red"}, 2: {"noun": "van", "material": "metal"}}


def box_lines(frames: int, ahead: int = 0) -> list[str]:
    """Boxes of two objects in each frame, in the layout of MOTChallenge's ground truth: object 1
    goes right and back by 0.5 px per frame, and object 2 down by 0.3 px per frame and up
    again. They are `ahead` frames further."""
    lines = []
    for f in range(frames):
        x = 4 + 0.5 * abs((f + ahead + 80) % 160 - 80)
        y = 4 + 0.3 * abs((f + ahead + 150) % 300 - 150)
        lines += [f"{f + 1},1,{x:.2f},20,8,6,1,1,1", f"{f + 1},2,60,{y:.2f},12,10,1,3,0.75"]
    return lines


def write_tracked_video(
    folder: Path, name: str = "street", frames: int = 140, fps: int = 25, *lines: str
) -> Path:
    """Write a video, its tracks (those of `box_lines`, unless others are given), and add its names
    to tracks.yaml. Return the path of the tracks."""
    write_video(folder / f"{name}.mp4", frames, SIZE, fps)
    text = "\n".join(lines or box_lines(frames)) + "\n"
    (folder / f"{name}.txt").write_text(text, errors="surrogateescape")
    path = folder / "tracks.yaml"
    content = yaml.safe_load(path.read_text()) if path.exists() else {"videos": {}}
    content["videos"][name] = {"objects": NAMES}
    path.write_text(yaml.safe_dump(content))
    return folder / f"{name}.txt"
