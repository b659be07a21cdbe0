"""Examples in a TFRecord file, read without TensorFlow.

A file is a row of records: the length of the data (uint64), a checksum of the length (uint32), the
data, a checksum of the data (uint32), all little-endian. The data of a record is a protocol buffer
of type tf.train.Example: a map from a feature's name to a list of bytes, of floats or of integers.
TensorFlow Datasets flattens nested features into names such as `events/collisions/frame`, and an
array into one list.

The checksum of the data is not looked at: in Python that takes longer than all else.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from data.releases.validation import RecordError

HEADER, FOOTER = 12, 4
"""Bytes before and after a record's data."""
VARINT, EIGHT_BYTES, DELIMITED, FOUR_BYTES = 0, 1, 2, 5
"""Wire types of protocol buffers."""

Feature = list[bytes] | np.ndarray
"""A list of bytes, or a float32 or int64 array (length,)."""


def offsets(path: Path) -> list[int]:
    """Where each record of a file begins. A record that is cut off or damaged is the last: it hides
    those behind it."""
    size, start, found = path.stat().st_size, 0, []
    with open(path, "rb") as file:
        while start < size:
            found.append(start)
            file.seek(start)
            length = _length(file.read(HEADER))
            if length is None:
                break
            start += HEADER + length + FOOTER
    return found


def example(path: Path, number: int, names: Collection[str]) -> dict[str, Feature]:
    """The features of these names that record `number` of a file has.

    Raises:
        RecordError: there is no such record, or it is cut off or damaged.
    """
    starts = offsets(path)
    if number >= len(starts):
        raise RecordError(f"{path} has {len(starts)} records, expected one at {number}")
    with open(path, "rb") as file:
        file.seek(starts[number])
        length = _length(file.read(HEADER))
        if length is None:
            raise RecordError(
                f"{path}: record {number} does not begin with a length and its checksum"
            )
        data = file.read(length)
    if len(data) < length:
        raise RecordError(f"{path}: record {number} ends after {len(data)} of {length} bytes")
    try:
        return _features(memoryview(data), names)
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise RecordError(f"{path}: record {number} holds no tf.train.Example: {error}") from error


def _length(header: bytes) -> int | None:
    """The length that a record's header tells; None where it is cut off or its checksum differs."""
    told, checksum = header[:8], header[8:]
    if len(header) < HEADER or masked_crc(told) != int.from_bytes(checksum, "little"):
        return None
    return int.from_bytes(told, "little")


def masked_crc(data: bytes) -> int:
    """CRC-32C, rotated and offset as TFRecord stores it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _features(data: memoryview, names: Collection[str]) -> dict[str, Feature]:
    found = {}
    for _, features in _fields(data):
        for _, pair in _fields(features):
            named = dict(_fields(pair))
            name = bytes(named[1]).decode()
            if name in names:
                found[name] = _values(named[2])
    return found


def _values(feature: memoryview) -> Feature:
    for kind, listed in _fields(feature):
        values = [value for _, value in _fields(listed)]
        if kind == 1:
            return [bytes(value) for value in values]
        if kind == 2:
            return np.frombuffer(b"".join(values), "<f4")
        return np.array([n for value in values for n in _integers(value)], np.int64)
    return []


def _integers(value: int | memoryview) -> Iterator[int]:
    """One integer, or those packed into bytes, negative ones from their two's complement."""
    packed, at = value, 0
    if isinstance(packed, int):
        yield packed - (packed >> 63 << 64)
        return
    while at < len(packed):
        n, at = _varint(packed, at)
        yield n - (n >> 63 << 64)


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Number and value of each field of a message: an integer, or the bytes of all else."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        wire = key & 7
        if wire == VARINT:
            value, at = _varint(message, at)
            yield key >> 3, value
            continue
        if wire == DELIMITED:
            size, at = _varint(message, at)
        elif wire in (EIGHT_BYTES, FOUR_BYTES):
            size = 8 if wire == EIGHT_BYTES else 4
        else:
            raise ValueError(f"wire type {wire} at byte {at}")
        if at + size > len(message):
            raise ValueError(f"a field runs past the end at byte {at}")
        yield key >> 3, message[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """An integer in groups of seven bits, lowest first, and where the next field begins."""
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
