"""NPZ: numpy arrays by name."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxsid.checks import InputError
from jaxsid.files.table import Columns, Table


def open_npz(path: Path) -> Table:
    """The table of an NPZ file."""
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in archive.infolist()}
    except (zipfile.BadZipFile, OSError) as error:
        raise InputError(f"{path}: is not a readable NPZ file ({error}).") from None
    return Table(
        path=path,
        names=tuple(sizes),
        aliases={},
        size=lambda names: 2.0 * sum(sizes[name] for name in names),
        read=lambda names: read_npz(path, names),
        first_row=1,
    )


def read_npz(path: Path, names: Sequence[str]) -> Columns:
    """The named arrays; pickled objects are refused."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in names}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as NPZ: {error}.") from None
