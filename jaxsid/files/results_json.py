"""Results as JSON: arrays become lists, complex numbers pairs, and what is not a number null."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxsid.files.atomic import write_atomically

SCHEMA = 1


def write_json(path: Path | str, data: Mapping[str, Any]) -> None:
    """Write the data, `schema` first, so that the file is there whole or not at all.

    numpy and jax arrays become lists, complex numbers [real, imaginary], NaN and infinity null.

    Raises:
        InputError: the folder is missing or cannot be written to.
        TypeError: a value that JSON cannot hold, with where it stands.
    """
    ordered = {"schema": data.get("schema", SCHEMA), **{key: x for key, x in data.items() if key != "schema"}}
    text = json.dumps(plain(ordered, "data"), indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, lambda stream: stream.write(text + "\n"))


def plain(value: Any, where: str) -> Any:
    """The value in the types of JSON."""
    if value is None or isinstance(value, (bool, str, int)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, complex):
        return [plain(value.real, where), plain(value.imag, where)]
    if isinstance(value, Mapping):
        return {str(key): plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype != object:
            return plain(array.tolist(), where)
    raise TypeError(f"{where}: a {type(value).__name__} cannot be written as JSON.")
