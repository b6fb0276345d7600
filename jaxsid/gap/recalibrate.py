"""The linear parameters refitted to records, so that only what no linear model explains is left."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled_in_full
from jaxsid.gap.evidence import factor_of, table
from jaxsid.gap.noise import Noise, residual_noise
from jaxsid.gap.numbers import LEAST_CHANGE
from jaxsid.gap.resume import step
from jaxsid.gap.setting import Setting, element_directions, setting_of, slowest_rate
from jaxsid.gap.spectra import Motion, in_time, motion_under, parameter_columns, spectra_of
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import element_matrices, with_values
from jaxsid.records import Record

STEPS = 30  # of Gauss and Newton
ROUNDS = 3  # of finding the noise of what is left, where nothing else tells of it
SETTLED = 0.1, 1e-5  # sum of squares that a last step brings, and its part of what lies above the noise
LARGEST = 0.3  # relative change of an element in a step
FIXED = 1e-12  # deviation of what does not vary
WIDE = {"mass": 0.3, "stiffness": 0.3, "damping": 1.0}  # deviations of what is refitted freely


class Linear(eqx.Module):
    """A linear model beside one record.

    Attributes:
        motion: of the bodies, from the initial state that fits.
        left: (lines, outputs) measured less modelled.
        gram: (e + 1, e + 1) products of sensitivities and of what is left, whitened, without transients.
    """

    motion: Motion
    left: Complex[Array, "lines outputs"]
    gram: Float[Array, "e1 e1"]


class Recalibrated(NamedTuple):
    """A model whose linear parameters were refitted.

    Attributes:
        model: with them.
        change: (e,) relative to the nominal values.
        prior: (e,) standard deviations of the changes beforehand.
        covariance: (e, e) of the changes.
        settings: of each record.
        linear: of each record.
        noises: of each record; found from what is left where nothing else told.
        squares: sum of squares of what is left, in noise.
        equations: number of real equations behind it.
    """

    model: LumpedModel
    change: Float[np.ndarray, " e"]
    prior: Float[np.ndarray, " e"]
    covariance: Float[np.ndarray, "e e"]
    settings: tuple[Setting, ...]
    linear: tuple[Linear, ...]
    noises: tuple[Noise, ...]
    squares: float
    equations: int


@step
def recalibrated(
    model: LumpedModel,
    records: Sequence[Record],
    noises: Sequence[Noise],
    *,
    wide: bool,
    given: bool = False,
    start: Float[np.ndarray, " e"] | None = None,
) -> Recalibrated:
    """Least squares on the lines, by Gauss and Newton, with a normal prior about the nominal values.

    minimize sum |(Y - G(theta) U - T t) / S|^2 + sum ((theta - nominal) / std)^2 over theta and, for each record, t.

    Args:
        model: nominal.
        records: with some of its sensors each.
        noises: one a record; those of source "residual" are found anew from what is left.
        wide: whether the prior is wide, else the model's own tolerance.
        given: whether to take the noises as they are.
        start: changes to begin with too, beside none at all; the better fit counts.
    """
    elements = element_matrices(model)
    nominal = np.asarray(elements.nominal)
    near, far = (
        np.where(nominal != 0, np.maximum([of[x.quantity] for x in elements.listed], FIXED), FIXED)
        for of in (model.tolerance._asdict(), WIDE)
    )
    prior, noises = far if wide else near, tuple(noises)
    change = np.zeros(len(nominal))
    if wide:  # by way of the best values within the tolerance: from far off, others may be taken for them
        change = _fit(model, records, noises, change, near).change
    guessed = [n.degrees == 0 and not given for n in noises]
    fit = _fit(model, records, noises, change, prior)
    if start is not None:
        fit = min(fit, _fit(model, records, noises, start, prior), key=lambda x: _cost(x, prior))
    for _ in range(ROUNDS if any(guessed) else 0):
        noises = tuple(
            residual_noise(_signals(s, x)) if g else n
            for n, g, s, x in zip(noises, guessed, fit.settings, fit.linear, strict=True)
        )
        fit = _fit(model, records, noises, fit.change, prior)
    return fit


def as_given(model: LumpedModel, records: Sequence[Record], noises: Sequence[Noise]) -> Recalibrated:
    """A model as it is beside records, nothing refitted but the initial states.

    Args:
        model: its linear part.
        records: with some of its sensors each.
        noises: one a record.
    """
    count = len(element_matrices(model).listed)
    levels = [_levels(noise, record) for noise, record in zip(noises, records, strict=True)]
    return _evaluated(model, records, tuple(noises), np.zeros(count), np.full(count, FIXED), levels)


def _signals(setting: Setting, linear: Linear) -> np.ndarray:
    signals = np.asarray(in_time(setting.spectra, linear.left))
    return np.where(np.asarray(setting.spectra.present) > 0, signals, np.nan)


def _fit(
    model: LumpedModel,
    records: Sequence[Record],
    noises: tuple[Noise, ...],
    change: np.ndarray,
    prior: np.ndarray,
) -> Recalibrated:
    levels = [_levels(noise, record) for noise, record in zip(noises, records, strict=True)]
    best = _evaluated(model, records, noises, change, prior, levels)
    damping = 1e-3
    for _ in range(STEPS):
        gram = np.sum([np.asarray(x.gram) for x in best.linear], axis=0)
        k = len(change)
        own = gram[:k, :k] + np.diag(prior**-2)
        downhill = gram[:k, k] - best.change / prior**2
        step = np.linalg.solve(own + damping * np.diag(np.diag(own)), downhill)
        step = step / max(1.0, np.abs(step).max() / LARGEST)
        candidate = np.maximum(best.change + step, LEAST_CHANGE)
        found = _evaluated(model, records, noises, candidate, prior, levels)
        gain = _cost(best, prior) - _cost(found, prior)
        if gain > 0:
            best, damping = found, damping / 10
        else:
            damping *= 10
        above = max(_cost(best, prior) - best.equations, 0.0)
        if abs(gain) < SETTLED[0] + SETTLED[1] * above and (gain >= 0 or damping > 1e3):
            break
    return best


def _cost(fit: Recalibrated, prior: np.ndarray) -> float:
    return fit.squares + float(((fit.change / prior) ** 2).sum())


def _evaluated(
    model: LumpedModel,
    records: Sequence[Record],
    noises: tuple[Noise, ...],
    change: np.ndarray,
    prior: np.ndarray,
    levels: Sequence[np.ndarray],
) -> Recalibrated:
    elements = element_matrices(model)
    values = np.asarray(elements.nominal)
    moved = with_values(model, jnp.asarray(values * (1 + change)))
    # per nominal value, as the changes are
    directions = element_directions(model)
    rate = slowest_rate(moved)
    settings, linear = [], []
    for record, level in zip(records, levels, strict=True):
        spectra = spectra_of(moved, record)
        settings.append(setting_of(spectra, level, directions, rate))
        linear.append(beside(settings[-1]))
    gram = np.sum([np.asarray(x.gram) for x in linear], axis=0)
    covariance = np.linalg.inv(gram[:-1, :-1] + np.diag(prior**-2))
    equations = sum(int(2 * np.asarray(_weights(s)).sum()) for s in settings)
    return Recalibrated(
        moved,
        change,
        prior,
        covariance,
        tuple(settings),
        tuple(linear),
        tuple(noises),
        float(gram[-1, -1]),
        equations,
    )


def _levels(noise: Noise, record: Record) -> np.ndarray:
    """Standard deviations of a record's lines."""
    dt = float(record.dt)
    return noise.deviation(2 * np.pi * np.fft.rfftfreq(len(record.y), dt), dt)


def _weights(setting: Setting) -> Array:
    return setting.spectra.weight[:, None] * (setting.scale > 0)


@compiled_in_full
def beside(given: Setting) -> Linear:
    """A model's response from the initial state that fits, what it leaves, and how that changes with the elements.

    Args:
        given: record and model.
    """
    spectra = given.spectra
    left = spectra.y - spectra.response
    flat = lambda x: (x * given.scale[:, :, None]).reshape(-1, x.shape[2])  # noqa: E731
    columns, target = flat(spectra.free * given.transient), flat(left[:, :, None])
    lower, scale = factor_of(2 * (columns.conj().T @ columns).real)
    state = jax.scipy.linalg.cho_solve((lower, True), 2 * (columns.conj().T @ target[:, 0]).real / scale)
    state = given.transient * state / scale
    size = spectra.linear.mass.shape[0]
    motion = motion_under(spectra, jnp.zeros((len(left), size), left.dtype), state)
    both = jnp.concatenate([parameter_columns(spectra, motion, given.directions), left[:, :, None]], axis=2)
    none = jnp.zeros((1, len(left)), given.scale.dtype)
    # one factorization after another: side by side they can lock up the CPU's thread pool
    both, state = lax.optimization_barrier((both, state))
    found = table(both, spectra.free, jnp.zeros_like(left), given.scale, none, given.transient)
    return Linear(motion, left - spectra.free @ state, found.gram[0])
