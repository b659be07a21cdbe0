"""Tracks of objects in the text layouts of MOTChallenge: a box per line.

A line has 9 columns (MOTChallenge's ground truth) or 10 (its results). Their number decides, and is
the same on all lines of a file:

    frame, id, bb_left, bb_top, bb_width, bb_height, conf, class, visibility
    frame, id, bb_left, bb_top, bb_width, bb_height, conf, x, y, z

Frames count from 1, and boxes are in px. A box with conf 0 is ignored; in the layout of results, -1
states no confidence. A visibility of -1 is unknown. x, y and z are not used.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data.sources.validation import RecordError

LAYOUTS = {
    9: ["frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf", "class", "visibility"],
    10: ["frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf", "x", "y", "z"],
}
"""Names of the columns of a line, by their number."""
WHOLE = ("frame", "id", "class")
"""Columns of whole numbers."""
LEAST = {"frame": 1, "id": 0, "bb_width": 0, "bb_height": 0}
"""Smallest values of columns. Detections that no tracker has linked have id -1."""
RESULTS_COLUMNS = 10
CACHED_FILES = 2


class Track(NamedTuple):
    """The K boxes of an object, in order of frame.

    Attributes:
        frames: (K,) indices, from 0.
        centres: (K, 2) px.
        sizes: (K, 2) widths and heights, px.
        visibility: (K,) visible fractions; NaN in the layout of results.
        category: Number of the object's class on its first line; None in the layout of results.
        lines: (K,) numbers of the lines in the file.
    """

    frames: np.ndarray
    centres: np.ndarray
    sizes: np.ndarray
    visibility: np.ndarray
    category: int | None
    lines: np.ndarray

    def at(self, frames: np.ndarray) -> np.ndarray:
        """Return the centre at F frames, (F, 2) px: interpolated linearly where no box is listed,
        and that of the nearest box before the first and after the last one."""
        return np.stack([np.interp(frames, self.frames, c) for c in self.centres.T], axis=-1)


def read_tracks(path: Path) -> dict[int, Track]:
    """Return the tracks of a file by id, in order of id.

    Raises:
        RecordError: The file is missing, has no box, or a line without one of the layouts.
    """
    try:
        return _parse(path, path.stat().st_mtime_ns)
    except FileNotFoundError as error:
        raise RecordError(f"{path}, the tracks of a video, is missing", "missing-file") from error


@lru_cache(maxsize=CACHED_FILES)
def _parse(path: Path, modified: int) -> dict[int, Track]:
    """Parse a file. The clips of a video share the result, while the time `modified` of the file's
    last change stays the same."""
    first_lines: dict[tuple[int, int], int] = {}
    rows: list[tuple[float, ...]] = []
    columns = 0
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(",")]
        where = f"{path}: line {number} (frame {cells[0]})"
        if len(cells) not in LAYOUTS or (columns and len(cells) != columns):
            expected = columns or "9 or 10"
            raise RecordError(f"{where} has {len(cells)} columns, expected {expected}")
        columns = len(cells)
        row = {
            name: _parse_number(name, cell, where)
            for name, cell in zip(LAYOUTS[columns], cells, strict=True)
        }
        # In the layout of results, the last two are x and y.
        frame, key, left, top, width, height, confidence, category, visibility, *_ = row.values()
        if (other := first_lines.setdefault((key, frame), number)) != number:
            raise RecordError(
                f"{where}: id {key:.0f} has another box in this frame on line {other}"
            )
        is_result = columns == RESULTS_COLUMNS
        if confidence > 0 or (is_result and confidence == -1):
            if is_result or visibility < 0:
                visibility = np.nan
            centre = left + width / 2, top + height / 2
            rows.append((key, frame - 1, *centre, width, height, visibility, category, number))
    if not rows:
        raise RecordError(f"{path} has no box of an object: expected the tracks of a video")
    boxes = np.array(sorted(rows))
    tracks = {}
    for own in np.split(boxes, np.flatnonzero(np.diff(boxes[:, 0])) + 1):
        frames, lines = own[:, 1].astype(int), own[:, 8].astype(int)
        category = None if columns == RESULTS_COLUMNS else int(own[0, 7])
        track = Track(frames, own[:, 2:4], own[:, 4:6], own[:, 6], category, lines)
        tracks[int(own[0, 0])] = track
    return tracks


def _parse_number(name: str, cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    least = LEAST.get(name, -np.inf)
    if not np.isfinite(value) or value < least or (name in WHOLE and value % 1):
        kind = "whole number" if name in WHOLE else "number"
        bound = f" of at least {least}" if name in LEAST else ""
        raise RecordError(f"{where}: {name} is {cell!r}, expected a {kind}{bound}")
    return value
