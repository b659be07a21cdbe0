"""Groups and datasets of an HDF5 file, refused in one sentence where they are not as expected."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data.releases.validation import RecordError, finite_array

if TYPE_CHECKING:
    import h5py


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """A file to read from.

    Raises:
        RecordError: it is no HDF5, or damaged; also where that shows only on reading.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, KeyError, RuntimeError) as error:
        raise RecordError(f"{path} is no HDF5 file, damaged or cut off: {error}") from error


def where(parent: h5py.Group, *keys: str) -> str:
    """The file and the place in it, for a sentence."""
    return f"{parent.file.filename}: {'/'.join([parent.name.rstrip('/'), *keys])}"


def group(parent: h5py.Group, key: str) -> h5py.Group:
    if key not in parent or not hasattr(parent[key], "keys"):
        raise RecordError(f"{where(parent, key)} is missing, expected a group")
    return parent[key]


def dataset(parent: h5py.Group, *names: str) -> h5py.Dataset:
    """The first of `names` that is there."""
    for name in names:
        if name in parent and hasattr(parent[name], "dtype"):
            return parent[name]
    raise RecordError(f"{where(parent, names[0])} is missing, expected a dataset")


def array(parent: h5py.Group, *names: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Numbers of `shape`, where None stands for any length, as float32."""
    found = dataset(parent, *names)
    return finite_array(found[()], shape, where(found))


def integers(parent: h5py.Group, name: str, *tail: int) -> np.ndarray:
    """Whole numbers (any, *tail) as int64; an empty array may have another shape."""
    found = dataset(parent, name)
    values = np.asarray(found[()])
    if values.dtype.kind not in "iuf" or values.size % int(np.prod(tail)):
        raise RecordError(
            f"{where(found)} are {values.dtype} of shape {values.shape}, expected whole numbers"
        )
    return values.reshape(-1, *tail).astype(np.int64)
