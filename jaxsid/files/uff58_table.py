"""UFF 58: each dataset 58 is a channel, its abscissa is the time."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsid.checks import InputError, bad_input, require
from jaxsid.files.table import Columns, Table

TIME = "time"
UNKNOWN_FUNCTION, TIME_RESPONSE = 0, 1
DIRECTIONS = {0: "S", 1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"}
DIRECTIONS |= {-code: "-" + name[1:] for code, name in list(DIRECTIONS.items()) if code}
PARSING_COPIES = 12  # of the file's bytes: pyuff makes lists of Python numbers


def open_uff58(path: Path) -> Table:
    """The table of a UFF file, one channel for each time history among its datasets 58.

    A channel goes by one of its id lines, by node and direction such as "1:+Z", or by its index among the
    datasets 58, from 0.
    """
    headers = read_sets(path, header_only=True)
    indices = [
        i for i, header in enumerate(headers) if header["func_type"] in (UNKNOWN_FUNCTION, TIME_RESPONSE)
    ]
    types = sorted({header["func_type"] for header in headers})
    require(len(indices) > 0, f"{path}: holds no time history (type 1), only functions of type {types}.")
    labels = [labels_of(headers[i], i) for i in indices]
    names = [
        next((x for x in own if unique(x, labels)), f"dataset {i}")
        for i, own in zip(indices, labels, strict=True)
    ]
    aliases = {x: name for name, own in zip(names, labels, strict=True) for x in own if unique(x, labels)}
    places = dict(zip(names, indices, strict=True))
    bytes_per_channel = PARSING_COPIES * path.stat().st_size / len(headers)
    return Table(
        path=path,
        names=(TIME, *names),
        aliases=aliases,
        size=lambda wanted: bytes_per_channel * len(wanted),
        read=lambda wanted: read_uff58(path, places, wanted),
        first_row=1,
    )


def labels_of(header: dict[str, Any], index: int) -> list[str]:
    """All that a channel may be called by, the most telling first."""
    identities = [header.get(f"id{i}", "").strip() for i in range(1, 6)]
    response, reference = (point(header, role) for role in ("rsp", "ref"))
    entity = header.get("rsp_ent_name", "").strip()
    labels = [*identities, response, f"{response}/{reference}", entity, str(index)]
    return [x for x in dict.fromkeys(labels) if x and x.upper() != "NONE" and x != TIME]


def point(header: dict[str, Any], role: str) -> str:
    """Node and direction, such as "1:+Z"."""
    code = int(header.get(f"{role}_dir", 0))
    return f"{header.get(f'{role}_node', 0)}:{DIRECTIONS.get(code, code)}"


def unique(label: str, labels: Sequence[Sequence[str]]) -> bool:
    """Whether one channel only goes by this label."""
    return sum(label in own for own in labels) == 1


def read_sets(
    path: Path, *, header_only: bool = False, chosen: Sequence[int] | None = None
) -> list[dict[str, Any]]:
    """The datasets 58 of a file, all or those chosen by index among them."""
    import pyuff

    try:
        with warnings.catch_warnings(action="ignore"):
            file = pyuff.UFF(str(path))
            places = np.flatnonzero(np.asarray(file.get_set_types()) == 58)
            require(places.size > 0, f"{path}: holds no dataset 58. Is it a UFF file?")
            wanted = places if chosen is None else places[list(chosen)]
            return [dict(file.read_sets(int(i), header_only=header_only)) for i in wanted]  # type: ignore[arg-type]
    except InputError:
        raise
    except Exception as error:  # pyuff raises bare Exception
        raise InputError(f"{path}: cannot be read as UFF: {error}. It may be cut off or damaged.") from None


def read_uff58(path: Path, places: Mapping[str, int], wanted: Sequence[str]) -> Columns:
    """The named channels and their common time."""
    names = [name for name in wanted if name != TIME] or [next(iter(places))]
    sets = dict(zip(names, read_sets(path, chosen=[places[name] for name in names]), strict=True))
    for name, item in sets.items():
        count = len(item["data"])
        require(
            count >= item["num_pts"],
            f"{path}: column '{name}' (dataset {places[name]}) announces {item['num_pts']} samples and "
            f"holds {count}: "
            "the file is cut off or damaged.",
        )
    columns = {name: np.asarray(item["data"])[: item["num_pts"]] for name, item in sets.items()}
    return {TIME: common_time(path, sets)} | columns if TIME in wanted else columns


def common_time(path: Path, sets: Mapping[str, dict[str, Any]]) -> np.ndarray:
    """The abscissa that all channels share."""
    times = {name: np.asarray(item["x"])[: item["num_pts"]] for name, item in sets.items()}
    first = next(iter(times))
    for name, time in times.items():
        if not np.array_equal(time, times[first]):
            bad_input(
                f"{path}: columns '{first}' and '{name}' do not share the same time: {len(times[first])} "
                "samples "
                f"from {times[first][0]:g} s to {times[first][-1]:g} s, against {len(time)} from "
                f"{time[0]:g} s to "
                f"{time[-1]:g} s."
            )
    return times[first]
