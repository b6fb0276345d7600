"""One place after another, as arrays, so that one program serves them all: tables of evidence, motion under a force."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from jaxsid.compilation import compiled, compiled_in_full
from jaxsid.gap.evidence import Force, Table, density, factor_of, split, table
from jaxsid.gap.places import Place, joint_of
from jaxsid.gap.setting import Setting
from jaxsid.gap.signals import UNUSED, Extent, extent, shapes, signals
from jaxsid.gap.spectra import (
    Motion,
    Spectra,
    motion_under,
    parameter_columns,
    parameter_forces,
)
from jaxsid.mechanics.lumped import LumpedModel

KINDS = ("between", "sensor", "input")


class Ports(eqx.Module):
    """Places, a row each.

    Attributes:
        kind: (places,) 0 between two ends, 1 a sensor, 2 an input.
        joint: (places, N) where a force acts; zeros for a sensor.
        sensor: (places, outputs) 1 at the sensor.
        drive: (places, inputs) 1 at the input.
    """

    kind: Int[Array, " places"]
    joint: Float[Array, "places N"]
    sensor: Float[Array, "places outputs"]
    drive: Float[Array, "places inputs"]


class Guess(eqx.Module):
    """What is held for true at a place while its shapes are evaluated.

    Attributes:
        motion: of the bodies, a row for each place.
        size: extents of the place's signals over all records; None where its shapes play no part yet.
    """

    motion: Motion
    size: Extent | None


class Explained(eqx.Module):
    """What a place's best hypothesis makes of a record.

    Attributes:
        motion: of the bodies.
        force: (lines,) at the place, or what is added to the sensor.
        left: (lines, outputs) what it leaves, the process's share taken out too.
        across: () mean square, in noise, of what no signal of this place could explain; about 1 at the right one.
    """

    motion: Motion
    force: Complex[Array, " lines"]
    left: Complex[Array, "lines outputs"]
    across: Float[Array, ""]


class Chosen(NamedTuple):
    """The best hypothesis of each place: process, coefficients of elements and shapes."""

    force: Force
    coefficients: Float[Array, "places k"]


def ports_of(model: LumpedModel, places: tuple[Place, ...]) -> Ports:
    """Rows for places.

    Args:
        model: names what they are.
        places: from `places_of`.
    """
    sensors, inputs = [s.name for s in model.sensors], [i.name for i in model.inputs]
    mark = lambda where, names: [  # noqa: E731
        [float(p.where == where and p.ends[0] == name) for name in names] for p in places
    ]
    rows = [np.array([joint_of(model, p) for p in places]), mark("sensor", sensors), mark("input", inputs)]
    kind = jnp.asarray([KINDS.index(p.where) for p in places])
    return Ports(kind, *(jnp.asarray(np.array(x).reshape(len(places), -1), float) for x in rows))


def transfers_of(spectra: Spectra, port: Ports) -> tuple[Array, Array]:
    """From a process at a place, and from its shapes: the latter pass through the hold where they are inputs.

    Args:
        spectra: of the record.
        port: the place.
    """
    plain = spectra.forced @ port.joint + port.sensor
    return plain, jnp.where(port.kind == 2, spectra.driven @ port.drive, plain)


def columns_of(given: Setting, port: Ports, motion: Motion, size: Extent | None) -> Array:
    """(lines, outputs, e + k): elements, then shapes of a place, none without its extents.

    Args:
        given: record and model.
        port: the place.
        motion: that both are evaluated on.
        size: extents of the place's signals.
    """
    spectra = given.spectra
    elements = parameter_columns(spectra, motion, given.directions)
    if size is None:
        return elements
    pair = signals(port.kind, spectra, motion, port.joint, port.sensor, port.drive)
    held = transfers_of(spectra, port)[1]
    shaped = held[:, :, None] * shapes(port.kind, spectra, pair, size, given.rate)[:, None, :]
    shaped = shaped.at[:, :, UNUSED].add(_read_before(spectra, port, size))
    return jnp.concatenate([elements, shaped], axis=2)


def _read_before(spectra: Spectra, port: Ports, size: Extent) -> Complex[Array, "lines outputs"]:
    """An accelerometer sees a held input at once, but the step before where the input comes late, however little.

    So what a small delay or lag does to readings is far more than what it does to the motion. Zeros unless the place
    is an input.
    """
    linear = spectra.linear
    seen = linear.acceleration_sensors @ spectra.inverse_mass @ linear.input_matrix @ port.drive
    step = (jnp.exp(-1j * spectra.omega * spectra.dt) - 1) * (spectra.u @ port.drive)
    return step[:, None] * seen / jnp.maximum(size.rms[0], jnp.finfo(seen.dtype).tiny)


@compiled_in_full
def tables(
    given: Setting,
    ports: Ports,
    guess: Guess,
    force: Force,
    whitening: Complex[Array, "lines outputs outputs"] | None = None,
) -> Table:
    """Tables (places, h, ...) of a record.

    Args:
        given: record and model.
        ports: places.
        guess: their motion and extents.
        force: processes (places, h).
        whitening: what makes noise that sensors have in common white, in place of the setting's scale.
    """
    spectra = given.spectra
    left = (spectra.y - spectra.response)[:, :, None]
    seen = given.scale if whitening is None else (given.scale > 0) * 1.0
    mixed = (lambda x: x) if whitening is None else lambda x: jnp.einsum("lpq,lq...->lp...", whitening, x)

    def one(row: tuple[Ports, Guess, Force]) -> Table:
        port, guess, force = row
        columns = jnp.concatenate([columns_of(given, port, guess.motion, guess.size), left], axis=2)
        plain, _ = transfers_of(spectra, port)
        densities = density(force, spectra.omega, spectra.dt)
        return table(mixed(columns), mixed(spectra.free), mixed(plain), seen, densities, given.transient)

    return lax.map(one, (ports, guess, force))


@compiled
def extents(given: Setting, ports: Ports, motion: Motion) -> Extent:
    """Of the signals of every place, (places, 2); arguments as of `tables`."""

    def one(row: tuple[Ports, Motion]) -> Extent:
        port, moved = row
        pair = signals(port.kind, given.spectra, moved, port.joint, port.sensor, port.drive)
        return extent(given.spectra, pair)

    return lax.map(one, (ports, motion))


@compiled
def explained(given: Setting, ports: Ports, guess: Guess, chosen: Chosen) -> Explained:
    """What every place makes of a record, a row each.

    Args:
        given: record and model.
        ports: places.
        guess: motion and extents that the shapes are evaluated with.
        chosen: hypothesis and coefficients of every place.
    """
    return lax.map(lambda row: _explained(given, *row), (ports, guess, chosen))


def _explained(given: Setting, port: Ports, guess: Guess, chosen: Chosen) -> Explained:
    spectra, elements = given.spectra, len(given.directions[0])
    columns = columns_of(given, port, guess.motion, guess.size)
    rest = spectra.y - spectra.response - columns @ chosen.coefficients
    plain, _ = transfers_of(spectra, port)
    one = Force(*(x[None] for x in chosen.force))
    variance = density(one, spectra.omega, spectra.dt)[0]
    transient, rest = _cleared(given, plain, variance, rest)
    along, beside, square = split((rest * given.scale)[:, :, None], plain * given.scale)
    root = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    process = variance * root / (1 + variance * square) * along[:, 0] * (square > 0)
    force = process
    if guess.size is not None:
        pair = signals(port.kind, spectra, guess.motion, port.joint, port.sensor, port.drive)
        force = (
            force + shapes(port.kind, spectra, pair, guess.size, given.rate) @ chosen.coefficients[elements:]
        )
    pushed = parameter_forces(guess.motion, given.directions) @ chosen.coefficients[:elements]
    motion = motion_under(spectra, pushed + force[:, None] * port.joint, transient)
    equations = jnp.maximum((given.scale > 0).sum() - len(square), 1)
    across = (jnp.abs(beside) ** 2).sum() / equations
    return Explained(motion, force, rest - plain * process[:, None], across)


def _cleared(given: Setting, plain: Array, variance: Array, rest: Array) -> tuple[Array, Array]:
    """The transient that explains most of what is left, and what is left then."""
    count = len(given.transient)
    every = jnp.concatenate([given.spectra.free * given.transient, rest[:, :, None]], axis=2)
    along, beside, square = split(every * given.scale[:, :, None], plain * given.scale)
    along = along / jnp.sqrt(1 + variance * square)[:, None]
    both = [x.reshape(-1, count + 1) for x in (along, beside)]
    gram = 2 * ((both[0].conj().T @ both[0]).real + (both[1].conj().T @ both[1]).real)
    lower, size = factor_of(gram[:count, :count])
    found = jax.scipy.linalg.cho_solve((lower, True), gram[:count, count] / size) / size
    return given.transient * found, rest - given.spectra.free @ (given.transient * found)
