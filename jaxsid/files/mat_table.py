"""MAT: MATLAB variables by name, versions 4 to 7.2 by scipy and 7.3 (HDF5) by h5py."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsid.checks import InputError
from jaxsid.files.table import Columns, Table

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
HDF5_PLACES = (0, 512, 1024, 2048)  # where the format allows its signature; MATLAB puts it at 512


def open_mat(path: Path) -> Table:
    """The table of a MAT file of any version."""
    with path.open("rb") as stream:
        head = stream.read(HDF5_PLACES[-1] + len(HDF5_MAGIC))
    return open_hdf5(path) if any(head[k:].startswith(HDF5_MAGIC) for k in HDF5_PLACES) else open_mat5(path)


def open_mat5(path: Path) -> Table:
    """The table of a MAT file up to version 7.2."""
    from scipy.io import whosmat

    try:
        with warnings.catch_warnings(action="ignore"):
            shapes = {name: shape for name, shape, _ in whosmat(path)}
    except Exception as error:  # scipy raises almost anything on damaged files
        raise InputError(f"{path}: is not a readable MAT file ({error}).") from None
    return Table(
        path=path,
        names=tuple(shapes),
        aliases={},
        size=lambda names: 16.0 * sum(int(np.prod(shapes[name])) for name in names),
        read=lambda names: read_mat5(path, names),
        first_row=1,
    )


def read_mat5(path: Path, names: Sequence[str]) -> Columns:
    """The named variables."""
    from scipy.io import loadmat

    try:
        with warnings.catch_warnings(action="ignore"):
            data = loadmat(path, variable_names=list(names))
    except Exception as error:
        raise InputError(f"{path}: cannot be read as MAT: {error}.") from None
    return {name: data[name] for name in names}


def open_hdf5(path: Path) -> Table:
    """The table of a MAT file of version 7.3."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            sizes = {name: item.size for name, item in file.items() if isinstance(item, h5py.Dataset)}
    except OSError as error:
        raise InputError(f"{path}: is not a readable MAT 7.3 file ({error}).") from None
    return Table(
        path=path,
        names=tuple(sizes),
        aliases={},
        size=lambda names: 16.0 * sum(sizes[name] or 0 for name in names),
        read=lambda names: read_hdf5(path, names),
        first_row=1,
    )


def read_hdf5(path: Path, names: Sequence[str]) -> Columns:
    """The named variables, turned so that rows come first."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return {name: rows_first(file[name]) for name in names}
    except OSError as error:
        raise InputError(f"{path}: cannot be read as MAT 7.3: {error}.") from None


def rows_first(item: Any) -> np.ndarray:
    """The array as MATLAB shows it, which is stored transposed; of other writers' files time is the "
    "longer axis."""
    values = np.asarray(item[()])
    if values.ndim != 2:
        return values
    transposed = "MATLAB_class" in item.attrs or values.shape[0] < values.shape[1]
    return values.T if transposed else values
