"""Read the examples of a TFRecord file without TensorFlow.

A file is a sequence of records: the length of the data (uint64), a checksum of the length (uint32),
the data, and a checksum of the data (uint32), all little-endian. The data is a protocol buffer of
type tf.train.Example, which maps the names of features to lists of bytes, floats or integers.
TensorFlow Datasets gives nested features names such as `events/collisions/frame`, and stores each
array as one flat list.

The checksums are not verified: in Python this would take longer than the rest of the reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from dynapix.data.sources.validation import RecordError

HEADER, FOOTER = 12, 4
"""Number of bytes before and after the data of a record."""


def record_ranges(path: Path) -> list[range]:
    """Return the range of bytes that contains the data of each record. If a length is damaged or
    the file is cut off, the last range reaches beyond the end of the file."""
    status = path.stat()
    return _record_ranges(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=16)
def _record_ranges(path: Path, size: int, modified: int) -> list[range]:
    start, ranges = 0, []
    with open(path, "rb") as file:
        while start < size:
            file.seek(start)
            length = int.from_bytes(file.read(8), "little")
            ranges.append(range(start + HEADER, start + HEADER + length))
            start = ranges[-1].stop + FOOTER
    return ranges


def read_example(path: Path, number: int) -> dict[str, Any]:
    """Return the features of record `number` (from 0) by name; `feature_values` converts them."""
    from google.protobuf.message import DecodeError

    where = f"{path}: record {number}"
    ranges = record_ranges(path)
    if number >= len(ranges) or ranges[number].stop > path.stat().st_size:
        raise RecordError(f"{where} is cut off or has a damaged length", "damaged-file")
    with open(path, "rb") as file:
        file.seek(ranges[number].start)
        data = file.read(len(ranges[number]))
    try:
        example = example_class().FromString(data)
    except DecodeError as error:
        raise RecordError(f"{where} is not a tf.train.Example: {error}", "damaged-file") from error
    return {entry.key: entry.value for entry in example.features.feature}


@cache
def example_class() -> type:
    """Return the message class of tf.train.Example."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format

    # A pool of our own cannot conflict with the tf.train.Example that TensorFlow registers.
    pool = descriptor_pool.DescriptorPool()
    schema = (files("dynapix.data.sources") / "example.textproto").read_text()
    pool.Add(text_format.Parse(schema, descriptor_pb2.FileDescriptorProto()))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("dynapix.Example"))


def feature_values(feature: Any) -> Sequence[Any]:
    """Return the values of a feature: bytes, floats or integers."""
    return feature.bytes_list.value or feature.float_list.value or feature.int64_list.value
