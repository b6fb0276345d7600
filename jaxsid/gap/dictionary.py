"""What every kind of effect would add to a record's lines, were it there, on a motion that is held for true.

One program serves all kinds of one sort of place. A kind is asked for its law, its friction, its memory and its
changes; what these do to the motion of its place, transformed and passed through the nominal transfer, are its columns.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled, compiled_in_full
from jaxsid.gap.evidence import factor_of
from jaxsid.gap.setting import Setting
from jaxsid.gap.spectra import Motion, Spectra, in_time, parameter_columns, readings
from jaxsid.mechanics.amplitudes import amplitudes
from jaxsid.mechanics.effects import kind as kinds
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.effects.kind import Changes, Kind, Nominal
from jaxsid.mechanics.effects.prior import Amplitudes
from jaxsid.mechanics.slots import Slots, nominal_at

FINER = 4  # steps of a law's memory for each sample


class Place(eqx.Module):
    """What the kinds see at one place of a record.

    Attributes:
        motion: (lines, 3) displacement, velocity, acceleration across it.
        samples: (samples, 2) displacement and velocity.
        finely: (FINER * samples, 2) likewise.
        smooth, jumping: (lines,) the signal, its part that jumps with a held input apart.
        nominal: what the model has there.
        way: 1 on a body, -1 between two ends: how a positive force acts along the place.
        omega: (lines,) rad/s.
        dt: sampling interval, s.
    """

    motion: Complex[Array, "lines 3"]
    samples: Float[Array, "samples 2"]
    finely: Float[Array, "fine 2"]
    smooth: Complex[Array, " lines"]
    jumping: Complex[Array, " lines"]
    nominal: Nominal
    way: Array
    omega: Float[Array, " lines"]
    dt: Float[Array, ""]


class Products(eqx.Module):
    """Of a kind's columns, the elements and the data, transients left out: (..., k + e + 1, k + e + 1), data last."""

    gram: Float[Array, "*shape k1 k1"]


@compiled
def sizes(given: Setting, slots: Slots, motion: Motion) -> Amplitudes:
    """How every place moves, each (places,).

    Args:
        given: record and model.
        slots: the places.
        motion: of the bodies, a row for each place.
    """
    spectra = given.spectra
    y = jnp.where(spectra.present > 0, in_time(spectra, spectra.y), jnp.nan)
    u = in_time(spectra, spectra.u)

    def one(row: tuple[Slots, Motion]) -> Amplitudes:
        slot, moved = jax.tree.map(lambda x: x[None], row[0]), row[1]
        q, v = jnp.split(in_time(spectra, moved.states), 2, axis=1)
        return jax.tree.map(lambda x: x[0], amplitudes(spectra.linear, slot, q, v, u, y, spectra.dt))

    return lax.map(one, (slots, motion))


@compiled_in_full
def products(
    given: Setting, slots: Slots, motion: Motion, jumps: Array, probes: Mapping[str, Array], where: str
) -> dict[str, Products]:
    """Products of the columns of kinds at places, of one record.

    Args:
        given: record and model.
        slots: the places, all of one sort.
        motion: of the bodies, a row for each place.
        jumps: (inputs,) 1 for inputs that jump at samples, 0 for others.
        probes: of each kind, (places, grid, columns, parameters + 1).
        where: the sort of the places.
    """
    spectra = given.spectra
    nominal = nominal_at(slots, spectra.linear)
    left = (spectra.y - spectra.response)[:, :, None]

    def one(row: tuple[Slots, Nominal, Motion, Mapping[str, Array]]) -> dict[str, Products]:
        slot, nominal, motion, probes = row
        elements = parameter_columns(spectra, motion, given.directions)
        beside = jnp.concatenate([spectra.free * given.transient, elements, left], axis=2)
        place = _place(spectra, slot, nominal, motion, jumps, where)
        transfers = _transfers(spectra, slot, where) * given.scale[:, :, None]
        near = _Near(beside * given.scale[:, :, None], transfers, len(given.transient))
        signals = {name: _signals(CATALOGUE[name], place, p, where) for name, p in probes.items()}
        return near.of_each(signals)

    return lax.map(one, (slots, nominal, motion, dict(probes)))


def columns(
    spectra: Spectra, slots: Slots, motion: Motion, jumps: Array, kind: str, probes: Array
) -> Complex[Array, "grid lines outputs k"]:
    """Columns of a kind at one place.

    Args:
        spectra: of the record.
        slots: one place, without an axis for places.
        motion: of the bodies.
        jumps: as of `products`.
        kind: its name.
        probes: (grid, columns, parameters + 1).
    """
    where = CATALOGUE[kind].where
    nominal = jax.tree.map(lambda x: x[0], nominal_at(jax.tree.map(lambda x: x[None], slots), spectra.linear))
    place = _place(spectra, slots, nominal, motion, jumps, where)
    signals = _signals(CATALOGUE[kind], place, probes, where)
    return jnp.einsum("lpt,gktl->glpk", _transfers(spectra, slots, where), signals)


class _Near:
    """What all kinds at a place have in common: products with its transfers, so that columns are never made."""

    def __init__(self, beside: Array, transfers: Array, transients: int) -> None:
        self.count = transients
        flat = beside.reshape(-1, beside.shape[2])
        gram = 2 * (flat.conj().T @ flat).real
        self.lower, self.size = factor_of(gram[:transients, :transients])
        self.half = self._halved(gram[:transients, transients:])
        self.gram = gram[transients:, transients:] - self.half.T @ self.half
        self.along = jnp.einsum("lpt,lpb->tlb", transfers.conj(), beside)
        self.square = jnp.einsum("lpt,lps->tsl", transfers.conj(), transfers)

    def _halved(self, rows: Array) -> Array:
        return jax.scipy.linalg.solve_triangular(self.lower, rows / self.size[:, None], lower=True)

    def of_each(self, signals: Mapping[str, Array]) -> dict[str, Products]:
        """Of kinds with as many columns at once, for the sake of a short program."""
        found = {}
        for count in {x.shape[1] for x in signals.values()}:
            names = [n for n, x in signals.items() if x.shape[1] == count]
            gram = self.products(jnp.concatenate([signals[n] for n in names])).gram
            ends = np.cumsum([len(signals[n]) for n in names])[:-1]
            found |= dict(zip(names, map(Products, jnp.split(gram, ends)), strict=True))
        return found

    def products(self, signals: Complex[Array, "grid k ports lines"]) -> Products:
        cross = 2 * jnp.einsum("gktl,tlb->gkb", signals.conj(), self.along).real
        own = 2 * jnp.einsum("gktl,tsl,gjsl->gkj", signals.conj(), self.square, signals).real
        half = jax.vmap(lambda x: self._halved(x.T))(cross[:, :, : self.count])
        cross = cross[:, :, self.count :] - jnp.einsum("gnk,nb->gkb", half, self.half)
        own = own - jnp.einsum("gnk,gnj->gkj", half, half)
        beside = jnp.broadcast_to(self.gram, (len(cross), *self.gram.shape))
        upper = jnp.concatenate([own, cross], axis=2)
        return Products(jnp.concatenate([upper, jnp.concatenate([cross.mT, beside], axis=2)], axis=1))


def _transfers(spectra: Spectra, slot: Slots, where: str) -> Complex[Array, "lines outputs ports"]:
    if where in ("between", "body"):
        return (spectra.forced @ slot.joints)[:, :, None]
    if where == "sensor":
        one = jnp.broadcast_to(slot.sensors, spectra.y.shape)
        return one[:, :, None].astype(spectra.y.dtype)
    direct = _direct(spectra) @ slot.inputs
    held = spectra.driven @ slot.inputs
    return jnp.stack([held - direct, jnp.broadcast_to(direct, held.shape)], axis=2)


def _direct(spectra: Spectra) -> Array:
    linear = spectra.linear
    return linear.acceleration_sensors @ spectra.inverse_mass @ linear.input_matrix


def _place(
    spectra: Spectra, slot: Slots, nominal: Nominal, motion: Motion, jumps: Array, where: str
) -> Place:
    q, v = jnp.split(motion.states, 2, axis=1)
    across = jnp.stack([x @ slot.joints for x in (q, v, motion.accelerations)], axis=1)
    samples, finely = in_time(spectra, across[:, :2]), jnp.zeros((0, 2), spectra.omega.dtype)
    if where == "between":
        many = FINER * spectra.samples
        finely = FINER * jnp.fft.irfft(across[:, :2] * np.sqrt(spectra.samples), many, axis=0)
    if where == "input":
        given = spectra.u @ slot.inputs
        smooth, jumping = given, jnp.where(slot.inputs @ jumps > 0, given, jnp.zeros_like(given))
    else:
        jumping = (spectra.u * jumps) @ (_direct(spectra).T @ slot.sensors)
        smooth = readings(spectra, motion) @ slot.sensors - jumping
    way = jnp.sign(slot.joints @ slot.pushes)
    return Place(across, samples, finely, smooth, jumping, nominal, way, spectra.omega, spectra.dt)


def _signals(
    kind: Kind, place: Place, probes: Float[Array, "grid k p1"], where: str
) -> Complex[Array, "grid k ports lines"]:
    if where in ("between", "body"):
        memory = None
        if kind.rate is not None:
            # of the first column: linear parameters do not change a memory
            memory = jax.vmap(lambda p: _memory(kind, place, p))(probes[:, 0])
        one = lambda z, p: _pushed(kind, place, z, p)  # noqa: E731
        each = jax.vmap(jax.vmap(one, (None, 0)), (None if memory is None else 0, 0))(memory, probes)
        return each[:, :, None]
    return jax.vmap(jax.vmap(lambda p: _passed(kind, place, p, where)))(probes)


def _lines(x: Array) -> Array:
    return jnp.fft.rfft(x) / np.sqrt(len(x))


def _pushed(kind: Kind, place: Place, memory: Array | None, p: Array) -> Complex[Array, " lines"]:
    """The force along a place: of laws at the samples, of changes at the lines, where they are exact."""
    d, v = place.samples.T
    t = place.dt * jnp.arange(len(d))
    force = jnp.zeros_like(d)
    if kind.force is not None:
        z = jnp.zeros_like(d) if memory is None else memory
        force = force + kind.force(kinds.Motion(d, v, z, t, place.nominal.stiffness), *p[:-1])
    if kind.slip is not None:
        width = p[-1] * jnp.sqrt((v**2).mean())
        force = force + kind.slip(jnp.abs(v), *p[:-1]) * jnp.tanh(v / jnp.where(width > 0, width, 1.0))
    lines = place.way * _lines(force)
    if kind.changes is None:
        return lines
    change = _full(kind.changes(place.nominal, *p[:-1]))
    weights = jnp.stack([change.stiffness, change.damping, change.mass])
    return lines - place.motion @ weights + _attached(change, place, len(d))


def _full(change: Changes) -> Changes:
    return Changes(*(jnp.asarray(x) for x in change))


def _attached(change: Changes, place: Place, count: int) -> Complex[Array, " lines"]:
    """The pull of a mass that hangs on a body and begins where that is, at its speed; exact between the lines too."""
    jw, heavy = 1j * place.omega, change.attached_mass > 0
    mass = jnp.where(heavy, change.attached_mass, 1.0)
    square, drag = change.attached_stiffness / mass, change.attached_damping / mass
    joint, below = square + jw * drag, square + jw * drag + jw**2
    moved = joint / jnp.where(below == 0, 1.0, below) * place.motion[:, 0]
    # relative to the solution that repeats, what is left of the start swings freely
    y = -_at_start(moved - place.motion[:, 0], count)
    v = -_at_start(jw * moved - place.motion[:, 1], count)
    root = jnp.sqrt((0.25 * drag**2 - square).astype(jw.dtype))
    root = jnp.where(jnp.abs(root) > 0, root, 1e-6)
    fast, slow = -0.5 * drag + root, -0.5 * drag - root
    t = place.dt * jnp.arange(count)
    one, other = (v - slow * y) / (2 * root), (fast * y - v) / (2 * root)
    freely = one * (square + drag * fast) * jnp.exp(fast * t) + other * (square + drag * slow) * jnp.exp(
        slow * t
    )
    pull = joint * (moved - place.motion[:, 0]) + _lines(freely.real)
    return jnp.where(heavy, mass * pull, 0.0)


def _memory(kind: Kind, place: Place, p: Array) -> Float[Array, " samples"]:
    """A law's own state along the motion, from zero, by Heun's method."""
    assert kind.rate is not None
    step, rate = place.dt / FINER, kind.rate
    moved = jnp.concatenate([place.finely, place.finely[-1:]])
    t = step * jnp.arange(len(moved))

    def of(z: Array, now: Array, t: Array) -> Array:
        return rate(kinds.Motion(now[0], now[1], z, t, place.nominal.stiffness), *p[:-1])

    def follow(z: Array, row: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        now, then, t, later = row
        first = of(z, now, t)
        second = of(z + step * first, then, later)
        return z + 0.5 * step * (first + second), z

    _, every = lax.scan(follow, jnp.zeros_like(p[0]), (moved[:-1], moved[1:], t[:-1], t[1:]), unroll=4)
    return every[::FINER]


def _passed(kind: Kind, place: Place, p: Array, where: str) -> Complex[Array, "ports lines"]:
    """What a signal is, after its changes, less what it was."""
    assert kind.changes is not None
    change = _full(kind.changes(place.nominal, *p[:-1]))
    jw, dt = 1j * place.omega, place.dt
    smoothly = jnp.exp(-jw * change.delay) / (1 + jw * change.lag)
    # what jumps at a sample is seen late by whole samples, and lags as held
    z = jnp.exp(jw * dt)
    lagging = change.lag > 0
    keeps = jnp.where(lagging, jnp.exp(-dt / jnp.where(lagging, change.lag, 1.0)), 0.0)
    held = jnp.where(lagging, (1 - keeps) / (z - keeps), 1.0) * z ** -jnp.ceil(change.delay / dt)
    count = place.samples.shape[0]
    limit = jnp.where(
        change.inverse_limit > 0, 1 / jnp.where(change.inverse_limit > 0, change.inverse_limit, 1), 0
    )
    whole = place.smooth if where == "input" else place.smooth + place.jumping
    x = jnp.fft.irfft(whole * np.sqrt(count), count)
    cut = jnp.where(limit > 0, _lines(jnp.clip(x, -limit, limit)) - whole, jnp.zeros_like(whole))
    offset = jnp.zeros_like(whole).at[0].set(change.offset * np.sqrt(count))
    given, t = place.smooth + cut, dt * jnp.arange(count)
    if where == "input":
        follows = jnp.where((place.jumping != 0).any(), held, smoothly)
        late = [
            (1 + change.gain) * _arrived(f * given, 0.0, 0.0, change, dt, count) for f in (smoothly, follows)
        ]
        return jnp.stack(late) - whole + offset
    # a slope takes out the jump from a record's end to its start, which would ring
    read = jnp.fft.irfft(given * np.sqrt(count), count)
    slope = (2 * read[-1] - read[-2] - read[0]) / (count * dt)
    lines = smoothly * (given - _lines(slope * t)) + held * place.jumping
    return ((1 + change.gain) * _arrived(lines, slope, read[0], change, dt, count) - whole + offset)[None]


def _at_start(lines: Array, count: int) -> Array:
    return jnp.fft.irfft(lines * np.sqrt(count), count)[0]


def _arrived(
    lines: Array, slope: Array | float, before: Array | float, change: Changes, dt: Array, count: int
) -> Array:
    """The same, but with one value before a record began, instead of what wrapped around its end."""
    x, t = jnp.fft.irfft(lines * np.sqrt(count), count), dt * jnp.arange(count)
    since, lagging = t - change.delay, change.lag > 0
    x = x + slope * (since - change.lag)
    first = jnp.interp(change.delay, t, x)
    fades = jnp.exp(-jnp.maximum(since, 0.0) / jnp.where(lagging, change.lag, 1.0))
    x = x + jnp.where(lagging, (before - first) * fades, 0.0)
    return _lines(jnp.where(since < 0, before, x))
