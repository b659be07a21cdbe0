"""Tracks of objects in the text layouts of MOTChallenge: a box per line.

A line has 9 columns (MOTChallenge's ground truth) or 10 (its results). Their number decides, and is
the same on all lines of a file:

    frame, id, bb_left, bb_top, bb_width, bb_height, conf, class, visibility
    frame, id, bb_left, bb_top, bb_width, bb_height, conf, x, y, z

Frames count from 1, and boxes are in px. A box is ignored if its conf is at most 0, except that -1
states no confidence in the layout of results. A visibility is from 0 to 1; -1 is unknown. x, y and
z are not used.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from dynapix.data.sources.validation import Layout, RecordError, check_layout

Whole = Annotated[float, Field(multiple_of=1)]


class Box(Layout, strict=False):
    """A line. Detections that no tracker has linked have id -1; they are refused."""

    frame: Annotated[Whole, Field(ge=1)]
    id: Annotated[Whole, Field(ge=0)]
    bb_left: float
    bb_top: float
    bb_width: Annotated[float, Field(ge=0)]
    bb_height: Annotated[float, Field(ge=0)]
    conf: float
    category: Whole = Field(np.nan, alias="class")
    visibility: Annotated[float, Field(ge=-1, le=1)] = np.nan


TRUTH = ["frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf", "class", "visibility"]
COLUMNS = {9: TRUTH, 10: [*TRUTH[:7], "x", "y", "z"]}
"""Names of the columns of a line, by their number."""
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
    """Return the tracks of a file by id, in order of id."""
    try:
        return _parse(path, path.stat().st_mtime_ns)
    except FileNotFoundError as error:
        raise RecordError(f"{path}, the tracks of a video, is missing", "missing-file") from error


@lru_cache(maxsize=CACHED_FILES)
def _parse(path: Path, modified: int) -> dict[int, Track]:
    """Parse a file. The clips of a video share the result, while the time `modified` of the file's
    last change stays the same."""
    first_lines: dict[tuple[float, float], int] = {}
    rows: list[tuple[float, ...]] = []
    expected = [*COLUMNS]
    # A character that is no UTF-8 makes a cell that is no number.
    text = path.read_text("utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(",")]
        where = f"{path}: line {number} (frame {cells[0]})"
        if len(cells) not in expected:
            numbers = " or ".join(map(str, expected))
            raise RecordError(f"{where} has {len(cells)} columns, expected {numbers}")
        expected = [len(cells)]
        box = check_layout(where, dict(zip(COLUMNS[len(cells)], cells, strict=True)), Box)
        if (other := first_lines.setdefault((box.id, box.frame), number)) != number:
            raise RecordError(
                f"{where}: id {box.id:.0f} has another box in this frame on line {other}"
            )
        if box.conf > 0 or (len(cells) == 10 and box.conf == -1):
            centre = box.bb_left + box.bb_width / 2, box.bb_top + box.bb_height / 2
            visibility = box.visibility if box.visibility >= 0 else np.nan
            sizes = box.bb_width, box.bb_height
            rows.append((box.id, box.frame - 1, *centre, *sizes, visibility, box.category, number))
    if not rows:
        raise RecordError(f"{path} has no box of an object: expected the tracks of a video")
    boxes = np.array(sorted(rows))
    tracks = {}
    for own in np.split(boxes, np.flatnonzero(np.diff(boxes[:, 0])) + 1):
        frames, lines = own[:, 1].astype(int), own[:, 8].astype(int)
        category = None if np.isnan(own[0, 7]) else int(own[0, 7])
        track = Track(frames, own[:, 2:4], own[:, 4:6], own[:, 6], category, lines)
        tracks[int(own[0, 0])] = track
    return tracks
