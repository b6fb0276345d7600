"""Motion with its slopes, marched in many windows: against forward differentiation of one simulation after another."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import DT, chain

from jaxsid.gap.hypothesis import effect_slots
from jaxsid.mechanics.augmented import augmented
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Effect, second_order
from jaxsid.mechanics.nonlinear import forced, respond_to
from jaxsid.mechanics.sensitivity import Laws, Windows, linear_part, marched

PLACES = {"between": ("b1", "b2"), "body": "b2", "sensor": "s1", "input": "drive"}
VALUES = {
    "actuator_lag": {"time_constant": 0.4 * DT},
    "actuator_saturation": {"limit": 0.8},
    "sensor_lag": {"time_constant": 2.3 * DT},
    "sensor_delay": {"delay": 2.3 * DT},
    "input_delay": {"delay": 1.4 * DT},
    "missing_mode": {"mass": 0.2, "stiffness": 400.0, "damping": 0.1},
    "sensor_bias": {"offset": 0.3},
    "hysteresis": {"stiffness": 200.0, "beta": 5.0, "gamma": 3.0, "exponent": 1.3},
    "periodic_disturbance": {"amplitude": 0.7, "frequency_hz": 3.0, "phase": 0.4},
    "coulomb_friction": {"force": 0.2},
    "stribeck_friction": {"force": 0.1, "static_force": 0.3, "velocity": 0.02},
    "cubic_stiffness": {"coefficient": 1e6},
    "end_stop": {"stiffness": 1e4, "clearance": 1e-3},
    "time_varying_stiffness": {"rate": 0.3},
}
PAIRS = [
    ("sensor_delay", "cubic_stiffness"),
    ("coulomb_friction", "hysteresis"),
    ("coulomb_friction", "stribeck_friction"),
    ("input_delay", "coulomb_friction"),
    ("missing_mode", "end_stop"),
]
LEAD, LENGTH, WINDOWS, SUBSTEPS, END = 8, 40, 3, 2, 29


def effect(kind, place=None):
    where = CATALOGUE[kind].where
    return Effect(kind, ((where, place or PLACES[where]),), VALUES[kind])


def case(kinds):
    """Slots, inputs and initial states of windows, with a body's acceleration among the readings."""
    effects = [
        effect(k, ("ground", "b1") if i and k.endswith("friction") else None) for i, k in enumerate(kinds)
    ]
    rng = np.random.default_rng(len(kinds))
    u = jnp.asarray(rng.standard_normal((WINDOWS, LEAD + LENGTH, 1)))
    slots = effect_slots(chain(), effects)
    n = 2 * (3 + slots.count)
    states = jnp.asarray(rng.standard_normal((WINDOWS, n)) * np.where(np.arange(n) < 3, 1e-3, 0.03))
    windows = Windows(u, jnp.asarray([False]), LEAD, jnp.asarray(DT), jnp.asarray([0, 50, 700]), states, END)
    return second_order(chain()), slots, windows


def moved(linear, slots, theta):
    """Masses, one spring and all parameters, changed in proportion."""
    mass = linear.mass * (1 + theta[0])
    stiffness = linear.stiffness.at[1, 1].multiply(1 + theta[1])
    linear = eqx.tree_at(lambda s: (s.mass, s.stiffness), linear, (mass, stiffness))
    rows = slots.parameters * (1 + theta[2:].reshape(slots.parameters.shape))
    return linear, eqx.tree_at(lambda s: s.parameters, slots, rows)


def one_by_one(linear, slots, windows, theta):
    """Readings, (windows, samples, outputs, 1 + directions), states likewise, forces, by plain differentiation."""

    def readings(theta, state, u, first):
        changed = moved(linear, slots, theta)
        system = augmented(*changed)
        late = forced(system, changed[1], u, windows.ramps, windows.dt)
        late = late._replace(**{k: getattr(late, k)[LEAD:] for k in late._fields[:4]})
        found = respond_to(system, changed[1], late, windows.dt, state, SUBSTEPS, first)
        both = found.outputs, found.states[END]
        return both, (both, found.forces)

    def window(state, u, first):
        slopes, (both, forces) = jax.jacfwd(readings, (0, 1), has_aux=True)(theta, state, u, first)
        whole = (jnp.concatenate([x[..., None], *s], axis=-1) for x, s in zip(both, slopes, strict=True))
        return *whole, forces

    return jax.jit(jax.vmap(window))(windows.states, windows.u, windows.first)


@eqx.filter_jit
def all_at_once(linear, slots, windows, theta):
    def part(theta):
        changed = moved(linear, slots, theta)
        return linear_part(*changed, windows.dt, jnp.asarray(SUBSTEPS)), changed[1].parameters

    (own, rows), (slopes, row_slopes) = part(theta), jax.jacfwd(part)(theta)
    every = [jnp.broadcast_to(x[..., None], (*x.shape, WINDOWS)) for x in (rows, row_slopes)]
    return marched(own, slopes, Laws(slots.kinds, *every), windows, jnp.asarray(SUBSTEPS))


# each compiles a program of its own
QUICK = PAIRS[:1]
EVERY = [*QUICK, *(pytest.param(k, marks=pytest.mark.slow) for k in [*[(k,) for k in VALUES], *PAIRS[1:]])]


@pytest.mark.parametrize("kinds", EVERY, ids="+".join)
def test_marching_all_windows_is_differentiating_each(kinds):
    linear, slots, windows = case(kinds)
    theta = jnp.zeros(2 + slots.parameters.size)
    found = all_at_once(linear, slots, windows, theta)
    readings, ends, forces = one_by_one(linear, slots, windows, theta)
    own = np.moveaxis(np.asarray(found.outputs), -1, 0)
    size = np.abs(readings).max(axis=(0, 1, 2))
    assert (size > 0).sum() > 8
    size = np.where(size > 0, size, 1.0)
    np.testing.assert_allclose(own / size, readings / size, atol=1e-9)
    size = np.maximum(np.abs(ends).max(axis=0), 1e-9)
    np.testing.assert_allclose(np.moveaxis(np.asarray(found.ends), -1, 0) / size, ends / size, atol=1e-9)
    np.testing.assert_allclose(np.moveaxis(np.asarray(found.forces), -1, 0), forces, rtol=1e-9, atol=1e-12)
