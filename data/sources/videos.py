"""Videos: their frame rate, size and number of frames, and the pixels of single frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from PIL import Image

from dynapix.data.sources.validation import RecordError

if TYPE_CHECKING:
    from av.container import InputContainer

SEEK_MARGIN = 32
"""Number of frames before the first wanted frame at which decoding starts: a key frame may be
stored before frames that are shown earlier, and a search for their time may find it."""


class Video(NamedTuple):
    """The first video stream of a file.

    Attributes:
        fps: Mean number of frames per second; None if the container does not tell.
        size: Width and height, px.
        times: Time of each frame in the order in which they are shown, in units of the stream;
            None where the container does not tell.
    """

    fps: float | None
    size: tuple[int, int]
    times: list[int | None]


@contextmanager
def open_video(path: Path) -> Iterator[InputContainer]:
    """Open a file with a video stream. Raises RecordError if it is missing or damaged, also while
    it is read."""
    import av

    if not path.is_file():
        raise RecordError(f"video {path} is missing", "missing-file")
    try:
        with av.open(str(path)) as video:
            if not video.streams.video:
                raise RecordError(f"{path} contains no video")
            yield video
    except av.FFmpegError as error:
        raise RecordError(f"{path} cannot be decoded: {error.strerror}", "damaged-file") from error


def describe_video(path: Path) -> Video:
    """Describe a video from its packets, which is faster than decoding the frames."""
    with open_video(path) as video:
        stream = video.streams.video[0]
        packets = [p for p in video.demux(stream) if p.size > 0 and not p.is_discard]
        times = [packet.pts for packet in packets]
        rate, size = stream.average_rate, (stream.width, stream.height)
    return Video(float(rate) if rate else None, size, times if None in times else sorted(times))


def load_frames(path: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Return frames of a video as RGB images, by frame index."""
    wanted = set(frames)
    if not wanted:
        return {}
    times = describe_video(path).times
    index_of = {time: k for k, time in enumerate(times)}
    start = min(wanted) - SEEK_MARGIN
    can_seek = None not in index_of and len(index_of) == len(times) > start > 0
    images: dict[int, Image.Image] = {}
    # If a search for the time finds a later frame, decode again from the start of the video.
    for since in ([times[start]] if can_seek else []) + [None]:
        with open_video(path) as video:
            stream = video.streams.video[0]
            if since is not None:
                video.seek(since, stream=stream)
            for number, frame in enumerate(video.decode(stream)):
                index = number if since is None else index_of.get(frame.pts)
                if index in wanted:
                    images[index] = frame.to_image()
                    if len(images) == len(wanted):
                        return images
    missing = min(wanted - images.keys())
    raise RecordError(f"{path} ends before frame {missing}", "damaged-file")
