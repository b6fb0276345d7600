"""The factors of a study: what each may be, and what it is where the study does not say."""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxsid.checks import bad_input, require
from jaxsid.files.naming import listing, suggestion
from jaxsid.realization.window import check_order, check_reach
from jaxsid.study.noise import COLOURS
from jaxsid.study.system import System

Value = str | int | float | bool
METHODS = ("fourier", "direct", "wavelet", "inband")
EXCITATIONS = ("multisine", "white", "chirp")
ORDER = re.compile(r"true(\+\d+)?")
MOST_ROWS = 400  # of a Hankel matrix that nobody asked to be larger
RECORD_LENGTH = 8  # times the length of the impulse response


class Factor(NamedTuple):
    """What one factor may be: one of the choices, or a number from `least` on ("above" it, if open)."""

    kind: type
    choices: tuple[str, ...] = ()
    least: float = 0
    open: bool = False


FACTORS = {
    "system": Factor(str),
    "sensors": Factor(str),
    "inputs": Factor(str),
    "data": Factor(str, ("impulse", "record")),
    "rate": Factor(float, open=True),
    "samples": Factor(int, least=8),
    "record_samples": Factor(int, least=16),
    "excitation": Factor(str, EXCITATIONS),
    "excitation_seed": Factor(int),
    "noise": Factor(float),
    "colour": Factor(str, COLOURS),
    "method": Factor(str, METHODS),
    "realization": Factor(str, ("era", "era_dc")),
    "order": Factor(int, least=1),
    "rows": Factor(int, least=1),
    "cols": Factor(int, least=1),
    "stride": Factor(int, least=1),
    "lags": Factor(int, least=1),
    "first_lag": Factor(int),
    "lag_step": Factor(int, least=1),
}
OF_RECORDS = {"record_samples": 0, "excitation": "", "excitation_seed": 0, "method": ""}
OF_CORRELATIONS = {"lags": 0, "first_lag": 0, "lag_step": 0}


def checked_value(name: str, value: Any, where: str) -> Value:
    """A value of a factor in its own type, or InputError.

    Args:
        name: of the factor.
        value: as the file gives it.
        where: file and key, for the message.
    """
    factor = FACTORS[name]
    if name == "order" and isinstance(value, str) and ORDER.fullmatch(value):
        return value
    if factor.kind is str:
        if not isinstance(value, str) or (factor.choices and value not in factor.choices):
            hint = suggestion(value, factor.choices) if isinstance(value, str) else ""
            allowed = f"one of {listing(factor.choices)}" if factor.choices else "text"
            bad_input(f"{where}: must be {allowed}, but found {value!r}.{hint}")
        return value
    number = isinstance(value, int) or (factor.kind is float and isinstance(value, float))
    fits = number and not isinstance(value, bool) and _inside(float(value), factor)
    if not fits:
        word = "a whole number" if factor.kind is int else "a number"
        limit = "above" if factor.open else "from"
        extra = ', or "true" (that of the system), or "true+2" and the like' if name == "order" else ""
        bad_input(
            f"{where}: must be {word} {limit} {factor.least:g}{' on' * (not factor.open)}{extra}, but found {value!r}."
        )
    return factor.kind(value)


def _inside(value: float, factor: Factor) -> bool:
    return value < float("inf") and (value > factor.least if factor.open else value >= factor.least)


def resolve(given: Mapping[str, Value], system: System, seed: int = 0) -> dict[str, Value]:
    """Every factor's value in one case; one that has no meaning there is "" or 0.

    Args:
        given: values of some factors, checked one by one.
        system: of the case, with its sensors and inputs.
        seed: of the excitation unless given.

    Raises:
        InputError: a window that does not fit the samples or the order, a record shorter than the response.
    """
    v: dict[str, Any] = {
        "sensors": "default",
        "inputs": "default",
        "data": "impulse",
        "noise": 0.01,
        "colour": "white",
    }
    v |= {"realization": "era", "stride": 1, "rate": system.rate, "samples": system.samples, "order": "true"}
    v |= {"record_samples": 0, "method": "inband", "excitation": "multisine", "excitation_seed": seed} | dict(
        given
    )
    if isinstance(v["order"], str):
        v["order"] = system.order + int(v["order"].removeprefix("true") or 0)
    v["record_samples"] = v["record_samples"] or RECORD_LENGTH * v["samples"]
    if v["data"] == "impulse":
        v |= OF_RECORDS
    else:
        _check_record(v, system)
    v = _era_window(v, system) if v["realization"] == "era" else _era_dc_window(v, system)
    return {name: v[name] for name in FACTORS}


def _check_record(v: dict[str, Any], system: System) -> None:
    samples, length = v["samples"], v["record_samples"]
    require(
        samples <= length,
        f"{system.name}: an impulse response of {samples} samples cannot come from a record of {length}. Ask for fewer "
        "samples, or for more record_samples.",
    )
    require(
        v["method"] != "fourier" or samples <= length // 4,
        f"{system.name}: method 'fourier' averages segments of a quarter of the record, {length // 4} of {length} "
        f"samples, which cannot show an impulse response of {samples}. Ask for fewer samples, or more record_samples.",
    )


def _era_window(v: dict[str, Any], system: System) -> dict[str, Any]:
    """As many blocks as the samples allow, half rows and half columns, the rows within MOST_ROWS."""
    outputs, inputs = system.model.C.shape[0], system.model.B.shape[1]
    blocks = (v["samples"] - 3) // v["stride"] + 2  # rows and cols together
    most = max(MOST_ROWS // outputs, -(-v["order"] // outputs), 2)
    rows = v.get("rows") or (max(blocks - v["cols"], 1) if v.get("cols") else max(min(blocks // 2, most), 1))
    cols = v.get("cols") or max(blocks - rows, 1)
    check_reach(v["stride"] * (rows + cols - 2) + 2, v["samples"])
    check_order(v["order"], (rows * outputs, cols * inputs))
    return v | {"rows": rows, "cols": cols} | OF_CORRELATIONS


def _era_dc_window(v: dict[str, Any], system: System) -> dict[str, Any]:
    """Few rows, the first lag behind them, lags over a third of the samples, and columns for the rest.

    Where that makes more than MOST_ROWS the lags are fewer, and further apart, but by no more than the rows bridge.
    """
    outputs, inputs = system.model.C.shape[0], system.model.B.shape[1]
    stride, third = v["stride"], v["samples"] // 6
    rows = v.get("rows") or max(-(-v["order"] // outputs), 2 if outputs < MOST_ROWS // 8 else 1)
    first = v.get("first_lag", rows * stride)
    least = max(-(-v["order"] // (rows * outputs)), 3)
    most = max(min(third // (v.get("lag_step") or 1), MOST_ROWS // (rows * outputs)), least)
    lags = v.get("lags") or most
    step = v.get("lag_step") or max(min(third // lags, rows), 1)
    reach = 2 + stride * (rows - 2) + first + 2 * (lags - 1) * step
    cols = v.get("cols") or max((v["samples"] - 1 - reach) // stride, 1)
    check_reach(reach + stride * cols, v["samples"])
    check_order(v["order"], (lags * rows * outputs, cols * inputs))
    return v | {"rows": rows, "cols": cols, "lags": lags, "first_lag": first, "lag_step": step}
