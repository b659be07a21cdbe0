"""Groups and datasets of an HDF5 file, each checked when it is read."""

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
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading.

    Raises:
        RecordError: The file is not HDF5 or is damaged, which may only show while it is read.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    # h5py raises a KeyError for a damaged object, with the message of the HDF5 library. A missing
    # key of our own dictionaries is a bug, not a damaged file.
    except (OSError, RuntimeError, KeyError) as error:
        if isinstance(error, KeyError) and not _is_raised_by_h5py(error):
            raise
        raise RecordError(
            f"{path} is damaged, cut off or not HDF5: {error}", "damaged-file"
        ) from error


def _is_raised_by_h5py(error: BaseException) -> bool:
    """Whether the innermost frame of a traceback is h5py's."""
    trace = error.__traceback__
    while trace.tb_next is not None:
        trace = trace.tb_next
    return trace.tb_frame.f_globals.get("__name__", "").startswith("h5py")


def locate(parent: h5py.Group, *keys: str) -> str:
    """Return the file and the path inside it, for error messages."""
    return f"{parent.file.filename}: {'/'.join([parent.name.rstrip('/'), *keys])}"


def get_group(parent: h5py.Group, key: str) -> h5py.Group:
    """Return a group of `parent`. Raises RecordError if it is missing."""
    if key not in parent or not hasattr(parent[key], "keys"):
        raise RecordError(f"{locate(parent, key)} is missing, expected a group")
    return parent[key]


def get_dataset(parent: h5py.Group, *names: str) -> h5py.Dataset:
    """Return the first dataset of `names` that exists. Raises RecordError if none does."""
    for name in names:
        if name in parent and hasattr(parent[name], "dtype"):
            return parent[name]
    raise RecordError(f"{locate(parent, names[0])} is missing, expected a dataset")


def read_floats(parent: h5py.Group, *names: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return a dataset as float32 of `shape`, in which None is any length."""
    dataset = get_dataset(parent, *names)
    return finite_array(dataset[()], shape, locate(dataset))


def read_integers(parent: h5py.Group, name: str, *tail: int) -> np.ndarray:
    """Return a dataset as int64 of shape (any, *tail); an empty one may have another shape."""
    dataset = get_dataset(parent, name)
    values = np.asarray(dataset[()])
    if values.dtype.kind not in "iuf" or values.size % int(np.prod(tail)):
        raise RecordError(
            f"{locate(dataset)}: {values.dtype} of shape {values.shape}, expected integers of "
            f"shape (any{''.join(f', {n}' for n in tail)})"
        )
    return values.reshape(-1, *tail).astype(np.int64)
