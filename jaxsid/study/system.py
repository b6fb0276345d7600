"""The systems of a study: the truth that realizations are drawn around, seen through chosen sensors and inputs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsid.checks import InputError, bad_input, require
from jaxsid.examples.structures import (
    ModalStructure,
    chain,
    galileo,
    mini_mast,
    railway_vehicle,
    turbine_generator,
)
from jaxsid.examples.systems import one_dof, rig, three_dof
from jaxsid.files.naming import listing, suggestion
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import LumpedModel, Sensor, check_lumped, second_order
from jaxsid.pipeline.setting import Setting, setting
from jaxsid.records import SENSOR_KINDS, ContinuousModel, Record, SecondOrderModel

TRANSLATION = ("kg", "N s/m", "N/m")
ROTATION = ("kg m^2", "N m s", "N m")
EITHER = ("kg or kg m^2", "N s/m or N m s", "N/m or N m")
ZERO = 1e-6  # poles within this share of the largest are free motion: no quantity


@dataclass(frozen=True)
class BuiltIn:
    """A system by name, and how long and how fast its impulse response is sampled unless a study says otherwise."""

    build: Callable[[], LumpedModel | ModalStructure]
    rate: float
    samples: int
    units: tuple[str, str, str] = TRANSLATION


# The rate is three to seven times the highest frequency; the length some four to eight periods of the lowest, or what
# the literature reports. A response much longer than it takes to die out adds noise and no signal.
BUILT_IN = {
    "one_dof": BuiltIn(one_dof, 1.0, 200),
    "chain2": BuiltIn(lambda: chain(2), 15.0, 100),
    "chain3": BuiltIn(three_dof, 4.0, 120),
    "chain7": BuiltIn(lambda: chain(7), 12.0, 120),
    "rig": BuiltIn(rig, 1000.0, 200, ROTATION),
    "mini_mast": BuiltIn(mini_mast, 50.0, 300),
    "galileo": BuiltIn(galileo, 102.4, 512),
    "railway_vehicle": BuiltIn(railway_vehicle, 40.0, 120),
    "turbine_generator": BuiltIn(turbine_generator, 160.0, 320, ROTATION),
}


class Mechanics(NamedTuple):
    """What a system of bodies has besides a state-space model."""

    matrices: SecondOrderModel
    setting: Setting
    units: tuple[str, str, str]


class System(NamedTuple):
    """A linear system as a study sees it.

    Attributes:
        name: for messages.
        model: the chosen inputs and outputs.
        poles: of the modes to be judged, one of each conjugate pair, slowest first, 1/s.
        order: number of states that the sensors can see; of a structure given by its modes, twice the number of modes
            that are excited well.
        rate: sampling rate unless the study says otherwise, Hz.
        samples: length of the impulse response, likewise.
        mechanics: None for a structure given by its modes.
    """

    name: str
    model: ContinuousModel
    poles: np.ndarray
    order: int
    rate: float
    samples: int
    mechanics: Mechanics | None


def make_system(name: str, sensors: str, inputs: str, given: LumpedModel | None = None) -> System:
    """A built-in system or a lumped model with the chosen sensors and inputs.

    Args:
        name: of a built-in system, or what the given model is to be called.
        sensors: "default", a kind ("acceleration") for one such sensor on every body, or names with commas between.
        inputs: "default" for all, or names with commas between.
        given: model from a file; None for a built-in one.

    Raises:
        InputError: unknown system, sensor or input, a model with effects.
    """
    if given is not None:
        return _lumped(name, _chosen(given, sensors, inputs), EITHER, None)
    if name not in BUILT_IN:
        bad_input(
            f"system '{name}' is unknown.{suggestion(name, BUILT_IN)} Built in are {listing(BUILT_IN)}; else give the "
            "path of a model file, which ends in .toml."
        )
    known = BUILT_IN[name]
    built = known.build()
    if isinstance(built, ModalStructure):
        return _modal(built, known, sensors, inputs)
    return _lumped(name, _chosen(built, sensors, inputs), known.units, known)


def _pick(text: str, names: Sequence[str], where: str) -> list[int]:
    """Indices of the names in a list with commas; all for "default"."""
    if text == "default":
        return list(range(len(names)))
    chosen = [part.strip() for part in text.split(",")]
    for part in chosen:
        if part not in names:
            bad_input(
                f"{where} '{part}' is unknown.{suggestion(part, names)} Known are 'default', {listing(names)}."
            )
    require(len(set(chosen)) == len(chosen), f"{where}: '{text}' names one of them twice.")
    return [names.index(part) for part in chosen]


def _chosen(model: LumpedModel, sensors: str, inputs: str) -> LumpedModel:
    require(
        not model.effects,
        f"{model.name}: it has effects ({', '.join(e.kind for e in model.effects)}); a study is of linear systems. "
        "Remove them to study the linear part.",
    )
    forces = [model.inputs[i] for i in _pick(inputs, [i.name for i in model.inputs], f"{model.name}: input")]
    if sensors in SENSOR_KINDS:
        seen = [Sensor(f"{sensors}_{body}", body, sensors) for body in model.bodies]
    else:
        try:
            indices = _pick(sensors, [s.name for s in model.sensors], f"{model.name}: sensor")
        except InputError as error:
            raise InputError(f"{error} Or give a kind for all bodies: {listing(SENSOR_KINDS)}.") from None
        seen = [model.sensors[i] for i in indices]
    require(bool(seen and forces), f"{model.name}: a study needs an input and a sensor.")
    chosen = replace(model, sensors=tuple(seen), inputs=tuple(forces))
    check_lumped(chosen)
    return chosen


def _lumped(name: str, model: LumpedModel, units: tuple[str, str, str], known: BuiltIn | None) -> System:
    matrices = second_order(model)
    linear = physical_displacement_velocity(matrices)
    blank = Record(
        np.zeros((1, len(model.inputs))),
        np.zeros((1, len(model.sensors))),
        1.0,
        inputs=[i.name for i in model.inputs],
        outputs=[s.name for s in model.sensors],
    )
    seen = setting(model, [blank])
    poles = _judged(np.linalg.eigvals(np.asarray(linear.A)), seen.visible)
    rate, samples = (known.rate, known.samples) if known else _advised(poles)
    return System(name, linear, poles, seen.visible, rate, samples, Mechanics(matrices, seen, units))


def _modal(structure: ModalStructure, known: BuiltIn, sensors: str, inputs: str) -> System:
    where = f"{structure.name}: "
    rows = np.array(_pick(sensors, structure.outputs, where + "sensor"))
    columns = np.array(_pick(inputs, structure.inputs, where + "input"))
    A, B, C, D = (np.asarray(getattr(structure.model, x)) for x in "ABCD")
    model = ContinuousModel(*(jnp.asarray(x) for x in (A, B[:, columns], C[rows], D[rows][:, columns])))
    w, zeta = 2 * np.pi * np.array(structure.frequencies), np.array(structure.damping_ratios)
    poles = w * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return System(structure.name, model, poles, 2 * len(poles), known.rate, known.samples, None)


def _judged(poles: np.ndarray, visible: int) -> np.ndarray:
    """One of each pair of the poles that sensors see, without free motion."""
    poles = poles[np.argsort(np.abs(poles))][len(poles) - visible :]
    return poles[(np.imag(poles) >= 0) & (np.abs(poles) > ZERO * np.abs(poles).max(initial=0.0))]


def _advised(poles: np.ndarray) -> tuple[float, int]:
    """Five times the highest frequency to two digits, and four periods of the slowest, 50 to 1000 samples."""
    require(len(poles) > 0, "the system has no pole that its sensors show: there is nothing to study.")
    highest = float(np.abs(poles).max()) / (2 * np.pi)
    rate = float(f"{5 * highest:.1e}")
    return rate, int(np.clip(np.ceil(4 * 5 * highest * 2 * np.pi / np.abs(poles).min()), 50, 1000))
