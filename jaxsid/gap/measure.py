"""How large the gap between a model and records is: in noise, relative, and where in frequency, time and amplitude.

With r what a model leaves and S the noise's covariance, G^2 = mean of r' S^-1 r: 1 is noise alone. The part beyond it
is the excess g, g^2 = max(G^2 - 1, 0).
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, gammaincc
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.gap.recalibrate import Recalibrated
from jaxsid.gap.setting import slowest_rate
from jaxsid.gap.spectra import in_time
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import LumpedModel, incidence, second_order
from jaxsid.mechanics.recursion import powers, run
from jaxsid.mechanics.simulate import ordered_inputs
from jaxsid.records import Record

SEGMENTS = 12  # of a record, in time
BINS = 6  # of amplitude, each with as many samples
FEWEST = 12  # lines of a band
HORIZONS = (0.1, 1.0, 10.0)  # periods of the slowest vibration
DISCOVERIES = 0.01  # rate of false ones among the bands called significant
LONGEST = 4096  # samples of a window


class Gap(NamedTuple):
    """The gap of one model.

    Attributes:
        nrmse: rms(y - yhat) / std(y) of each sensor over all records, the initial states fitted; by windows of
            one period where the model is free or unstable. NaN for sensors that no record has.
        noise_floor: that of noise alone.
        noise_units: G of each sensor.
        total: G of all.
        windowed: whether nrmse was judged by windows.
        by_sensor, by_frequency, by_amplitude, by_time, by_horizon: tables of plain values, as in diagnosis.json.
    """

    nrmse: dict[str, float]
    noise_floor: dict[str, float]
    noise_units: dict[str, float]
    total: float
    windowed: bool
    by_sensor: tuple[dict[str, Any], ...]
    by_frequency: tuple[dict[str, Any], ...]
    by_amplitude: tuple[dict[str, Any], ...]
    by_time: tuple[dict[str, Any], ...]
    by_horizon: tuple[dict[str, Any], ...]

    @property
    def excess(self) -> float:
        return float(np.sqrt(max(self.total**2 - 1, 0.0)))


def gap_of(fit: Recalibrated, records: Sequence[Record]) -> Gap:
    """The gap of a model, nominal or refitted, to records.

    Args:
        fit: the model beside the records.
        records: the same ones.
    """
    names = [s.name for s in fit.model.sensors]
    white = [_white(fit, i) for i in range(len(records))]
    power = [(w**2).mean(axis=0) for w in white]  # NaN for absent sensors
    counts = np.array([np.isfinite(w).all(axis=0) * len(w) for w in white])
    sensors = np.nansum(counts * np.array(power), axis=0) / np.maximum(counts.sum(axis=0), 1)
    horizons = _by_horizon(fit, records)
    windowed = is_free_or_unstable(fit.model)
    nrmse, floor = _relative(fit, records, horizons[1][1] if windowed else None)
    units = {
        n: float(np.sqrt(x)) if c else float("nan")
        for n, x, c in zip(names, sensors, counts.sum(axis=0), strict=True)
    }
    total = float(np.sqrt((counts.sum(axis=0) * sensors).sum() / max(counts.sum(), 1)))
    each = tuple(
        {
            "sensor": n,
            "nrmse": nrmse[n],
            "noise_floor": floor[n],
            "noise_units": units[n],
            "excess": float(np.sqrt(max(units[n] ** 2 - 1, 0.0))) if np.isfinite(units[n]) else float("nan"),
        }
        for n in names
    )
    return Gap(
        nrmse,
        floor,
        units,
        total,
        windowed,
        each,
        _by_frequency(fit, names),
        _by_amplitude(fit, white),
        _by_time(fit, white, names),
        (_one_step(fit, records), *(row for row, _ in horizons), _free_run(fit, total)),
    )


def is_free_or_unstable(model: LumpedModel) -> bool:
    """Whether a free run of the model drifts away, however small the disturbance.

    Args:
        model: its linear part.
    """
    poles = np.linalg.eigvals(np.asarray(physical_displacement_velocity(second_order(model)).A))
    return bool((poles.real >= -1e-7 * np.abs(poles).max()).any())


def _white(fit: Recalibrated, number: int) -> np.ndarray:
    """(samples, outputs) what is left of a record, of unit variance where it is noise; NaN for absent sensors."""
    setting, linear = fit.settings[number], fit.linear[number]
    root = np.sqrt(np.maximum(np.asarray(setting.spectra.weight), 1e-300))[:, None]
    lines = linear.left * jnp.asarray(np.asarray(setting.scale) / root)
    signals = np.asarray(in_time(setting.spectra, lines))
    return np.where(np.asarray(setting.spectra.present) > 0, signals, np.nan)


def _relative(
    fit: Recalibrated, records: Sequence[Record], windowed: np.ndarray | None
) -> tuple[dict[str, float], dict[str, float]]:
    """NRMSE of each sensor, and that of noise alone."""
    outputs = len(fit.model.sensors)
    left, size, noise = np.zeros(outputs), np.zeros(outputs), np.zeros(outputs)
    for setting, linear, found in zip(fit.settings, fit.linear, fit.noises, strict=True):
        present = np.asarray(setting.spectra.present) > 0
        y = np.asarray(in_time(setting.spectra, setting.spectra.y))
        left += present * (np.asarray(in_time(setting.spectra, linear.left)) ** 2).sum(axis=0)
        size += present * ((y - y.mean(axis=0)) ** 2).sum(axis=0)
        noise += np.where(present, found.rms() ** 2, 0.0) * len(y)
    size = np.where(size > 0, size, np.nan)
    left = left if windowed is None else windowed**2 * size
    names = [s.name for s in fit.model.sensors]
    tables = (dict(zip(names, np.sqrt(x / size).tolist(), strict=True)) for x in (left, noise))
    first, second = tables
    return first, second


def third_octaves(low: float, high: float) -> list[tuple[float, float]]:
    """Bands, Hz, that cover low to high; base-ten third octaves about 1 kHz (IEC 61260-1).

    Args:
        low: Hz, above zero.
        high: Hz.
    """
    first, last = (round(10 * np.log10(f / 1000)) for f in (low, high))
    return [(1000 * 10 ** ((n - 0.5) / 10), 1000 * 10 ** ((n + 0.5) / 10)) for n in range(first, last + 1)]


def _by_frequency(fit: Recalibrated, names: list[str]) -> tuple[dict[str, Any], ...]:
    rows, p_values = [], []
    nyquist = max(0.5 / float(s.spectra.dt) for s in fit.settings)
    low = min(1 / (float(s.spectra.dt) * s.spectra.samples) for s in fit.settings)
    degrees = sum(n.degrees for n in fit.noises)
    for band in third_octaves(max(low, 1e-4 * nyquist), nyquist):
        for j, name in enumerate(names):
            power, weight = 0.0, 0.0
            for setting, linear in zip(fit.settings, fit.linear, strict=True):
                f = np.asarray(setting.spectra.omega) / (2 * np.pi)
                inside = (f >= band[0]) & (f < band[1])
                scale = np.asarray(setting.scale)[inside, j]
                power += float((np.abs(np.asarray(linear.left)[inside, j] * scale) ** 2).sum())
                weight += float((np.asarray(setting.spectra.weight)[inside] * (scale > 0)).sum())
            if weight >= FEWEST:
                rows.append(
                    {"sensor": name, "band_hz": list(band), "noise_units": float(np.sqrt(power / weight))}
                )
                p_values.append(_excess_probability(power, weight, degrees))
    chosen = _discovered(np.array(p_values))
    return tuple(
        {**row, "p_value": p, "significant": bool(c)}
        for row, p, c in zip(rows, p_values, chosen, strict=True)
    )


def _excess_probability(power: float, lines: float, degrees: float) -> float:
    """Of as much power in so many lines of noise, which is known from so many values, or exactly where 0."""
    if degrees <= 0:
        return float(gammaincc(lines, power))
    return float(betainc(degrees / 2, lines, degrees / (degrees + 2 * power)))


def _discovered(p_values: np.ndarray) -> np.ndarray:
    """Which ones stand out, by the rule of Benjamini and Hochberg, J. R. Statist. Soc. B 57 (1995)."""
    order = np.argsort(p_values)
    good = p_values[order] <= DISCOVERIES * (np.arange(len(order)) + 1) / max(len(order), 1)
    limit = p_values[order][np.flatnonzero(good).max()] if good.any() else -1.0
    return p_values <= limit


def _by_time(fit: Recalibrated, white: list[np.ndarray], names: list[str]) -> tuple[dict[str, Any], ...]:
    rows = []
    for number, (setting, signals) in enumerate(zip(fit.settings, white, strict=True)):
        dt = float(setting.spectra.dt)
        ends = np.linspace(0, len(signals), SEGMENTS + 1).astype(int)
        for a, b in itertools.pairwise(ends):
            for j, name in enumerate(names):
                if b > a and np.isfinite(signals[a:b, j]).all():
                    units = float(np.sqrt((signals[a:b, j] ** 2).mean()))
                    rows.append(
                        {
                            "record": number,
                            "sensor": name,
                            "from_s": a * dt,
                            "to_s": b * dt,
                            "noise_units": units,
                        }
                    )
    return tuple(rows)


def _by_amplitude(fit: Recalibrated, white: list[np.ndarray]) -> tuple[dict[str, Any], ...]:
    """By relative displacement and velocity of every connection, of the model's own motion."""
    joints = incidence(fit.model)
    joints = joints if joints.size else np.eye(len(fit.model.bodies))
    labels = [list(c.between) for c in fit.model.connections] or [["ground", b] for b in fit.model.bodies]
    states = np.concatenate(
        [
            np.asarray(in_time(s.spectra, x.motion.states))
            for s, x in zip(fit.settings, fit.linear, strict=True)
        ]
    )
    power = np.concatenate([np.nanmean(w**2, axis=1) for w in white])
    size, rows = len(joints), []
    for joint, label in zip(joints.T, labels, strict=True):
        for what, signal in (
            ("displacement", states[:, :size] @ joint),
            ("velocity", states[:, size:] @ joint),
        ):
            edges = np.quantile(signal, np.linspace(0, 1, BINS + 1))
            at = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, BINS - 1)
            for i in range(BINS):
                if (at == i).any():
                    units = float(np.sqrt(power[at == i].mean()))
                    rows.append(
                        {
                            "between": label,
                            "of": what,
                            "range": edges[i : i + 2].tolist(),
                            "noise_units": units,
                        }
                    )
    return tuple(rows)


def _by_horizon(fit: Recalibrated, records: Sequence[Record]) -> list[tuple[dict[str, Any], np.ndarray]]:
    """G, and NRMSE of each sensor, of windows that begin anew from the initial state that fits each best."""
    found = []
    for part in HORIZONS:
        horizon = part * 2 * np.pi / slowest_rate(fit.model)
        each = [_one_horizon(fit, number, record, horizon) for number, record in enumerate(records)]
        squares, count, left, size = (sum(x) for x in zip(*each, strict=True))
        units = float(np.sqrt(squares / max(count, 1.0)))
        nrmse = np.sqrt(left / np.where(np.asarray(size) > 0, size, np.nan))
        found.append(({"name": f"{part:g} periods", "horizon_s": horizon, "noise_units": units}, nrmse))
    return found


def _free_run(fit: Recalibrated, total: float) -> dict[str, Any]:
    longest = max(s.spectra.samples * float(s.spectra.dt) for s in fit.settings)
    return {"name": "free run", "horizon_s": longest, "noise_units": total}


def _one_step(fit: Recalibrated, records: Sequence[Record]) -> dict[str, Any]:
    """G of one sample foretold from those before it, from the state that fits these best."""
    squares, count = 0.0, 0.0
    for number, record in enumerate(records):
        window = _window(fit, number, record)
        length = min(4 * len(fit.settings[number].transient) + 1, len(window.y))
        found = np.asarray(_last_of_windows(*window, length=length))
        squares, count = squares + found.sum(), count + len(found) * float((window.weight > 0).sum())
    step = min(float(r.dt) for r in records)
    return {"name": "one step", "horizon_s": step, "noise_units": float(np.sqrt(squares / max(count, 1.0)))}


def _one_horizon(
    fit: Recalibrated, number: int, record: Record, horizon: float
) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Of one record: sum of squares in noise, equations behind it, sums of squares left and measured."""
    setting, states = fit.settings[number], len(fit.settings[number].transient)
    samples = setting.spectra.samples
    length = min(max(int(horizon / float(record.dt)), 4 * states), LONGEST, samples)
    window = _window(fit, number, record)
    rest, weight = np.asarray(_windowed(*window, length=length)), np.asarray(window.weight)
    y, present = np.asarray(window.y), weight > 0
    used = rest.shape[0] * rest.shape[1]
    count = present.sum() * used - rest.shape[0] * states
    size = present * used * y.var(axis=0)
    return float(((rest * weight) ** 2).sum()), float(count), (rest**2).sum(axis=(0, 1)), size


class _Window(NamedTuple):
    """What windows of a record are cut from: sampled model, inputs, outputs, one over the noise, 0 where absent."""

    system: tuple[Array, Array, Array, Array]
    u: Array
    y: Array
    weight: Array


def _window(fit: Recalibrated, number: int, record: Record) -> _Window:
    spectra = fit.settings[number].spectra
    weight = np.where(np.asarray(spectra.present) > 0, 1 / fit.noises[number].rms(), 0.0)
    u, _ = ordered_inputs(fit.model, record)
    return _Window(
        _sampled(fit.model, record), jnp.asarray(u), in_time(spectra, spectra.y), jnp.asarray(weight)
    )


def _sampled(model: LumpedModel, record: Record) -> tuple[Array, Array, Array, Array]:
    hold = tuple("zero" if h == "band" else h for h in ordered_inputs(model, record)[1])
    sampled = discretise(physical_displacement_velocity(second_order(model)), record.dt, hold=hold)
    return sampled.A, sampled.B, sampled.C, sampled.D


@compiled
def _windowed(
    system: tuple[Array, Array, Array, Array], u: Array, y: Array, weight: Array, *, length: int
) -> Float[Array, "windows length outputs"]:
    """What the model leaves of windows, each from the state that fits it best."""
    target, basis = _whitened(system, u, y, weight, length)
    rest = (target - target @ basis @ basis.T).reshape(len(target), length, -1)
    return jnp.where(weight > 0, rest / jnp.where(weight > 0, weight, 1.0), 0.0)


@compiled
def _last_of_windows(
    system: tuple[Array, Array, Array, Array], u: Array, y: Array, weight: Array, *, length: int
) -> Float[Array, " windows"]:
    """Square, in its own deviations, of each window's last sample less what those before it foretell."""
    target, basis = _whitened(system, u, y, weight, length)
    last = basis[-len(weight) :]
    rest = target[:, -len(weight) :] - target @ basis @ last.T
    # left out of the fit, an error grows by this matrix, which is its covariance as well
    inner = jnp.eye(len(weight), dtype=last.dtype) - last @ last.T
    return (rest * jnp.linalg.solve(inner, rest.T).T).sum(axis=1)


def _whitened(
    system: tuple[Array, Array, Array, Array], u: Array, y: Array, weight: Array, length: int
) -> tuple[Float[Array, "windows rows"], Float[Array, "rows n"]]:
    """Windows less what the inputs do, in noise, and a basis of what states do to them."""
    A, B, C, D = system
    count = len(u) // length
    cut = lambda x: x[: count * length].reshape(count, length, -1)  # noqa: E731
    forced = jax.vmap(lambda part: run(A, B, C, D, part, jnp.zeros(len(A), A.dtype)))(cut(u))
    free = jnp.swapaxes(powers(A.T, C.T, length), 1, 2)
    columns = (free * weight[:, None]).reshape(-1, len(A))
    norm = jnp.linalg.norm(columns, axis=0)
    columns = columns / jnp.where(norm > 0, norm, 1.0)
    basis, s, _ = jnp.linalg.svd(columns, full_matrices=False)
    return ((cut(y) - forced) * weight).reshape(count, -1), basis * (s > 1e-8 * s[0])
