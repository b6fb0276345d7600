"""The study file: which cases there are, how many realizations of each, and what decides the numbers.

A study is a TOML file::

    name = "ERA against ERA/DC"
    seed = 1                    # of all chance
    realizations = 1000         # of each case
    chunk = 256                 # realizations computed and stored at a time, a multiple of 16
    sampling = "grid"           # every combination of the factors' values; or "random", with cases = 40

    [factors]                   # each a value, or a list of values
    system = ["chain3", "rig"]
    noise = [0.01, 0.05]
    realization = ["era", "era_dc"]

With sampling "random" each case draws every factor from its list, or from a range of numbers
`noise = {low = 1e-3, high = 0.1, scale = "log"}` (scale "linear" unless said); the draws depend on the seed only.
Cases that come out equal, such as two that differ in `lags` where there is only ERA, count once.

=================  ==========================================================================  =====================
factor             what it may be                                                              default
=================  ==========================================================================  =====================
system             one_dof, chain2, chain3, chain7, rig, mini_mast, galileo, railway_vehicle,
                   turbine_generator, or the path of a model file, from the study's folder     needed
sensors            "default"; a kind (displacement, velocity, acceleration) on every body; or
                   names in one text, "motor, load"                                            "default", all
inputs             "default", or names in one text                                             "default", all
data               "impulse": noise on the Markov parameters themselves; "record": noise on
                   the outputs of records, from which the impulse response is estimated        "impulse"
rate               sampling rate, Hz                                                           the system's
samples            of the impulse response that is realized                                    the system's
record_samples     of each record, one record for each input, driven alone from rest           8 samples
excitation         "multisine" (random phases, all frequencies), "white", "chirp"              "multisine"
excitation_seed    of the excitation, which is the same in all realizations                    the study's seed
noise              standard deviation over the rms of each output (over all samples and
                   inputs)                                                                     0.01
colour             "white", "coloured" (first order, pole 0.8), "quantization"                 "white"
method             "fourier", "direct", "wavelet", "inband", of records only                   "inband"
realization        "era", "era_dc"                                                             "era"
order              number of states, "true", or "true+2"                                       "true"
rows, cols         block rows and columns of the Hankel matrix                                 ERA: all samples, half
                                                                                               and half; ERA/DC: few
                                                                                               rows, else columns
stride             samples between neighbouring blocks                                         1
lags               block rows and columns of the correlation matrix, ERA/DC only               up to samples / 6
first_lag          of the correlations                                                         rows
lag_step           samples between lags                                                        1, or to span that
=================  ==========================================================================  =====================
"""

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxsid.checks import InputError, bad_input, require
from jaxsid.files.model_toml import model_text, read_model
from jaxsid.files.naming import listing, suggestion
from jaxsid.files.toml_file import checked, load_toml
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.study.factors import FACTORS, Factor, Value, checked_value, resolve
from jaxsid.study.system import System, make_system

if TYPE_CHECKING:
    from jaxsid.study.schema import StudyFile

BATCH = 16  # a chunk is a multiple of it, so that chunks give the bits of a run in one piece
MOST_CASES = 100_000


@dataclass(frozen=True)
class Case:
    """One setting of all factors.

    Attributes:
        index: number of the case, from 0.
        values: by factor; "" or 0 for one that has no meaning here.
        model: the lumped model, where the system is a file.
    """

    index: int
    values: dict[str, Value]
    model: LumpedModel | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Study:
    """What a study file says.

    Attributes:
        name: for reports.
        seed: of all chance.
        realizations: of each case.
        chunk: realizations that are computed and stored at a time.
        cases: all of them.
        varied: the factors of which the file gives several values.
        source: canonical JSON of all that decides the results of a realization.
    """

    name: str
    seed: int
    realizations: int
    chunk: int
    cases: tuple[Case, ...]
    varied: tuple[str, ...]
    source: str


@dataclass(frozen=True)
class Range:
    """Numbers from low to high, drawn evenly on a linear or logarithmic scale."""

    low: float
    high: float
    log: bool


Alternatives = dict[str, "list[Value] | Range"]


def read_study(path: Path) -> Study:
    """The study of a TOML file; see this module for its keys.

    Args:
        path: of the file.

    Raises:
        InputError: naming file and key, where the file is missing, is not TOML, has unknown keys, values that a factor
            cannot take, or factors that do not go together.
    """
    from jaxsid.study.schema import StudyFile

    path = Path(path)
    file = checked(StudyFile, load_toml(path), path, {})
    _check_top(file, path)
    alternatives = _alternatives(file, path)
    draws = _grid(alternatives, path) if file.sampling == "grid" else _random(alternatives, file)
    cases = _cases(draws, file.seed, path)
    varied = tuple(n for n, a in alternatives.items() if isinstance(a, Range) or len(a) > 1)
    source = _source(file.seed, cases)
    return Study(file.name, file.seed, file.realizations, file.chunk, cases, varied, source)


def _check_top(file: "StudyFile", path: Path) -> None:
    require(
        file.chunk % BATCH == 0,
        f"{path}: key 'chunk': must be a multiple of {BATCH}, but found {file.chunk}. "
        f"Take {max(round(file.chunk / BATCH), 1) * BATCH}.",
    )
    random = file.sampling == "random"
    require(
        random == (file.cases is not None),
        f"{path}: key 'cases': sampling = \"random\" needs a number of cases, such as cases = 40; a grid has "
        "as many as its factors make.",
    )
    require(
        "system" in file.factors,
        f"{path}: [factors], key 'system' is missing: name a built-in system or a model file.",
    )


def _alternatives(file: "StudyFile", path: Path) -> Alternatives:
    """The values or the range of each factor that the file names, in the order of FACTORS."""
    for name in file.factors:
        require(
            name in FACTORS,
            f"{path}: [factors], key '{name}' is unknown.{suggestion(name, FACTORS)} Known here: {listing(FACTORS)}.",
        )
    found: Alternatives = {}
    for name in FACTORS:
        if name in file.factors:
            given, where = file.factors[name], f"{path}: [factors], key '{name}'"
            if isinstance(given, dict):
                require(file.sampling == "random", f'{where}: a range needs sampling = "random".')
                found[name] = _range(name, given, where)
                continue
            given = given if isinstance(given, list) else [given]
            require(bool(given), f"{where}: the list is empty; give a value or leave the key out.")
            values = [checked_value(name, value, where) for value in given]
            require(len(set(values)) == len(values), f"{where}: names the same value twice.")
            found[name] = values
    return found


def _range(name: str, given: Mapping[str, Any], where: str) -> Range:
    factor: Factor = FACTORS[name]
    require(factor.kind is not str, f"{where}: takes words, not a range of numbers; give a list.")
    require(
        {"low", "high"} <= set(given) <= {"low", "high", "scale"},
        f"{where}: a range has the keys 'low', 'high' and 'scale', but found {listing(given)}.",
    )
    scale = given.get("scale", "linear")
    require(scale in ("linear", "log"), f"{where}: scale must be 'linear' or 'log', but found {scale!r}.")
    low, high = (checked_value(name, given[end], f"{where}, {end}") for end in ("low", "high"))
    require(
        not isinstance(low, str) and not isinstance(high, str), f"{where}: the ends of a range are numbers."
    )
    low, high = float(low), float(high)
    require(low < high, f"{where}: low must be below high, but found {low:g} and {high:g}.")
    require(scale == "linear" or low > 0, f"{where}: a logarithmic scale starts above 0, but low is {low:g}.")
    return Range(low, high, scale == "log")


def _grid(alternatives: Alternatives, path: Path) -> list[dict[str, Value]]:
    lists = [a for a in alternatives.values() if isinstance(a, list)]
    count = int(np.prod([len(values) for values in lists]))
    require(
        count <= MOST_CASES,
        f'{path}: the grid has {count} cases, more than {MOST_CASES}. Draw some of them: sampling = "random".',
    )
    return [dict(zip(alternatives, values, strict=True)) for values in itertools.product(*lists)]


def _random(alternatives: Alternatives, file: "StudyFile") -> list[dict[str, Value]]:
    assert file.cases is not None
    rng = np.random.default_rng(file.seed)
    return [
        {name: _draw(name, choice, float(rng.random())) for name, choice in alternatives.items()}
        for _ in range(file.cases)
    ]


def _draw(name: str, choice: "list[Value] | Range", share: float) -> Value:
    """What lies at this share, from 0 to 1, of the alternatives."""
    if isinstance(choice, list):
        return choice[int(share * len(choice))]
    low, high = choice.low, choice.high
    value = low * (high / low) ** share if choice.log else low + (high - low) * share
    return round(value) if FACTORS[name].kind is int else float(f"{value:.6g}")


def _cases(draws: list[dict[str, Value]], seed: int, path: Path) -> tuple[Case, ...]:
    """Complete cases without repetition."""
    systems: dict[tuple[Value, ...], System] = {}
    models: dict[str, LumpedModel | None] = {}
    found: dict[str, Case] = {}
    for draw in draws:
        name = str(draw["system"])
        key = tuple(draw.get(part, "default") for part in ("system", "sensors", "inputs"))
        try:
            if name not in models:
                models[name] = read_model(path.parent / name) if name.endswith(".toml") else None
            if key not in systems:
                systems[key] = make_system(name, str(key[1]), str(key[2]), models[name])
            values = resolve(draw, systems[key], seed)
        except InputError as error:
            words = ", ".join(f"{n} = {value!r}" for n, value in draw.items())
            bad_input(f"{path}: the case {words} cannot be run: {error}")
        found.setdefault(json.dumps(values), Case(len(found), values, models[name]))
    return tuple(found.values())


def _source(seed: int, cases: tuple[Case, ...]) -> str:
    """Seed, cases and models: equal text, equal results."""
    models = {str(c.values["system"]): model_text(c.model, "") for c in cases if c.model is not None}
    content = {"seed": seed, "cases": [c.values for c in cases], "models": models}
    return json.dumps(content, sort_keys=True, separators=(",", ":"))
