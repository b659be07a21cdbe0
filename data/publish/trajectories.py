"""Trajectories of objects on the floor, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from data.publish.contact_sheets import INK, encode_figure
from data.records import Scene
from data.render.appearance import RGB
from data.world.camera import STANDARD_CAMERA
from data.world.shapes import RADIUS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FLOOR_ACROSS, FLOOR_DOWN = (-3.6, 3.6), (-4.4, 2.8)
"""Extent of the drawn floor in simulator units; the camera is below."""
MARKERS = {"cube": "s", "sphere": "o", "cylinder": "H"}
LABEL_OFFSETS = ((8, 5), (8, -15), (-24, 5), (-24, -15))
"""Offsets in points of collision labels, so that labels at one place do not overlap."""


def draw_trajectories(scenes: Sequence[Scene], columns: int = 3) -> bytes:
    """Return a PNG with the top view of each scene; the camera is below and looks up."""
    from matplotlib.figure import Figure

    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(6.2 * columns, 6.6 * rows), dpi=100, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(scenes) :]:
        axes.set_axis_off()
    for axes, scene in zip(grid, scenes, strict=False):
        _draw_scene(axes, scene)
    return encode_figure(figure)


def _draw_scene(axes: Axes, scene: Scene) -> None:
    axes.set_facecolor("#e4e4e4")
    axes.fill(*visible_floor().T, facecolor="white", edgecolor="#bbbbbb")
    for k, look in enumerate(scene.objects):
        across, down = scene.positions[:, k, 1], scene.positions[:, k, 0]
        color = np.array(RGB[look.color]) / 255
        axes.plot(across, down, color=color, linewidth=2.2, zorder=2)
        second = round(scene.fps)
        axes.plot(across[::second], down[::second], ".", color=color, markersize=7, zorder=3)
        marker = {"marker": MARKERS[look.shape], "markersize": 13, "linestyle": "none", "zorder": 4}
        edge = "white" if look.material == "metal" else INK
        axes.plot(across[0], down[0], **marker, mfc="none", mec=color, mew=2)
        axes.plot(across[-1], down[-1], **marker, mfc=color, mec=edge, mew=1.5, label=look.phrase)
    for k, collision in enumerate(scene.collisions):
        down, across = scene.positions[collision.frame, list(collision.objects), :2].mean(axis=0)
        axes.plot(across, down, "x", color=INK, markersize=11, mew=2.5, zorder=5)
        axes.annotate(
            str(collision.frame), (across, down), LABEL_OFFSETS[k % len(LABEL_OFFSETS)],
            textcoords="offset points", fontsize=11, fontweight="bold", zorder=6, clip_on=True,
        )  # fmt: skip
    axes.set(xlim=FLOOR_ACROSS, ylim=FLOOR_DOWN[::-1], aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"{scene.scene_id} ({scene.split})", fontsize=13, fontweight="bold")
    axes.set_xlabel("the camera's side", fontsize=11)
    axes.legend(fontsize=8.5, loc="lower left", framealpha=0.85, labelspacing=0.7)


def visible_floor() -> np.ndarray:
    """Return the (4, 2) corners of the floor in the camera's image, across and down the drawing."""
    camera = STANDARD_CAMERA
    rays = camera.rays(
        np.array([0, camera.width, camera.width, 0]) - 0.5,
        np.array([0, 0, camera.height, camera.height]) - 0.5,
    )
    height = camera.eye[2] - RADIUS
    points = np.asarray(camera.eye) + rays * (height / -rays[:, 2:])
    return points[:, [1, 0]]
