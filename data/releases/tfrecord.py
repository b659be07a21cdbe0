"""Read the examples of a TFRecord file without TensorFlow.

A file is a sequence of records: the length of the data (uint64), a checksum of the length (uint32),
the data, and a checksum of the data (uint32), all little-endian. The data is a protocol buffer of
type tf.train.Example, which maps the names of features to lists of bytes, floats or integers.
TensorFlow Datasets gives nested features names such as `events/collisions/frame`, and stores each
array as one flat list.

The checksum of the data is not verified: in Python this would take longer than the rest of the
reading.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from data.releases.validation import RecordError

HEADER, FOOTER = 12, 4
"""Number of bytes before and after the data of a record."""
SCHEMA = """
name: "example.proto" package: "dynapix" syntax: "proto3"
message_type { name: "BytesList"
  field { name: "value" number: 1 type: TYPE_BYTES label: LABEL_REPEATED } }
message_type { name: "FloatList"
  field { name: "value" number: 1 type: TYPE_FLOAT label: LABEL_REPEATED } }
message_type { name: "Int64List"
  field { name: "value" number: 1 type: TYPE_INT64 label: LABEL_REPEATED } }
message_type { name: "Feature"
  field { name: "bytes_list" number: 1 type: TYPE_MESSAGE type_name: ".dynapix.BytesList" }
  field { name: "float_list" number: 2 type: TYPE_MESSAGE type_name: ".dynapix.FloatList" }
  field { name: "int64_list" number: 3 type: TYPE_MESSAGE type_name: ".dynapix.Int64List" } }
message_type { name: "Entry"
  field { name: "key" number: 1 type: TYPE_STRING }
  field { name: "value" number: 2 type: TYPE_MESSAGE type_name: ".dynapix.Feature" } }
message_type { name: "Features"
  field { name: "feature" number: 1 type: TYPE_MESSAGE type_name: ".dynapix.Entry"
          label: LABEL_REPEATED } }
message_type { name: "Example"
  field { name: "features" number: 1 type: TYPE_MESSAGE type_name: ".dynapix.Features" } }
"""
"""Descriptor of tf.train.Example in the text format of protocol buffers."""


def record_offsets(path: Path) -> list[int]:
    """Return the byte offset of each record.

    The list ends with the first incomplete record or damaged header, because the records after it
    cannot be located.
    """
    size, start, offsets = path.stat().st_size, 0, []
    with open(path, "rb") as file:
        while start < size:
            offsets.append(start)
            file.seek(start)
            length = _read_length(file.read(HEADER))
            if length is None:
                break
            start += HEADER + length + FOOTER
    return offsets


def read_example(path: Path, number: int) -> dict[str, Any]:
    """Return the features of record `number` by name; `feature_values` converts them.

    Raises:
        RecordError: The record does not exist, is cut off or is damaged.
    """
    from google.protobuf.message import DecodeError

    offsets = record_offsets(path)
    if number >= len(offsets):
        raise RecordError(f"{path} has {len(offsets)} records: there is no record {number}")
    where = f"{path}: record {number}"
    with open(path, "rb") as file:
        file.seek(offsets[number])
        length = _read_length(file.read(HEADER))
        if length is None:
            raise RecordError(f"{where} has an incomplete or damaged header", "damaged-file")
        data = file.read(length)
    if len(data) < length:
        raise RecordError(f"{where} ends after {len(data)} of {length} bytes", "damaged-file")
    try:
        example = _example_class().FromString(data)
    except DecodeError as error:
        raise RecordError(f"{where} is not a tf.train.Example: {error}", "damaged-file") from error
    return {entry.key: entry.value for entry in example.features.feature}


@cache
def _example_class() -> type:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format

    # A pool of our own cannot conflict with the tf.train.Example that TensorFlow registers.
    pool = descriptor_pool.DescriptorPool()
    pool.Add(text_format.Parse(SCHEMA, descriptor_pb2.FileDescriptorProto()))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("dynapix.Example"))


def feature_values(feature: Any) -> list[bytes] | np.ndarray:
    """Return the values of a feature: a list of bytes, or a 1-D array of float32 or int64."""
    if feature.HasField("bytes_list"):
        return list(feature.bytes_list.value)
    if feature.HasField("float_list"):
        return np.array(feature.float_list.value, np.float32)
    return np.array(feature.int64_list.value, np.int64)


def _read_length(header: bytes) -> int | None:
    """Return the length in a record's header, or None if the header is incomplete or damaged."""
    length, checksum = header[:8], header[8:]
    if len(header) < HEADER or masked_crc(length) != int.from_bytes(checksum, "little"):
        return None
    return int.from_bytes(length, "little")


def masked_crc(data: bytes) -> int:
    """Return the CRC-32C of `data`, rotated and offset as TFRecord stores it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
