"""Groups and datasets of an HDF5 file, each checked when it is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data.releases.validation import RecordError, finite_array

if TYPE_CHECKING:
    import h5py


@contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading.

    Raises:
        RecordError: The file is not HDF5 or is damaged, which may only show while it is read.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError) as error:
        raise RecordError(
            f"{path} is damaged, cut off or not HDF5: {error}", "damaged-file"
        ) from error


def locate(parent: h5py.Group, *keys: str) -> str:
    """Return the file and the path inside it, for error messages."""
    return f"{parent.file.filename}: {'/'.join([parent.name.rstrip('/'), *keys])}"


def get_group(parent: h5py.Group, key: str) -> h5py.Group:
    """Return a group of `parent`. Raises RecordError if it is missing or damaged."""
    return _get(parent, (key,), "keys")


def get_dataset(parent: h5py.Group, key: str) -> h5py.Dataset:
    """Return a dataset of `parent`. Raises RecordError if it is missing or damaged.

    Later versions of Physion add a suffix to the names of datasets of a camera.
    """
    return _get(parent, (key, f"{key}_cam0"), "dtype")


def _get(parent: h5py.Group, keys: tuple[str, ...], attribute: str) -> Any:
    """The first of `keys` in `parent`, which must have an attribute."""
    for key in keys:
        # None if it is missing or its header is damaged.
        child = parent.get(key)
        if hasattr(child, attribute):
            return child
    if any(key in parent for key in keys):
        raise RecordError(f"{locate(parent, keys[0])} is damaged", "damaged-file")
    raise RecordError(f"{locate(parent, keys[0])} is missing")


def read_array(
    parent: h5py.Group, key: str, shape: tuple[int, ...], dtype: type = np.float32
) -> np.ndarray:
    """Return a dataset as an array of `shape`, in which -1 is any length.

    Raises:
        RecordError: The dataset is missing, or has as many axes as `shape` and other lengths.
    """
    dataset = get_dataset(parent, key)
    lengths = list(zip(dataset.shape, shape, strict=False))
    # A matrix may be stored flat, and an empty list of contacts has one axis.
    if dataset.ndim == len(shape) and any(-1 != wanted != found for found, wanted in lengths):
        raise RecordError(f"{locate(dataset)}: shape {dataset.shape}, expected {shape}")
    return finite_array(dataset[()], shape, locate(dataset), dtype)
