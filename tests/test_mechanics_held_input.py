"""Inputs that come late between two samples: against quadrature, and motion step by step from SciPy's exponential."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxsid.gap.hypothesis import effect_slots
from jaxsid.mechanics.held_input import Late, late_input, parabola_over_step
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor, lumped_model, second_order
from jaxsid.mechanics.nonlinear import respond

DT, MASS, STIFFNESS, DAMPING = 0.5, 2.0, 8.0, 0.4  # w DT = 1


@pytest.mark.parametrize(("begin", "length"), [(0.0, 1.0), (0.25, 0.25), (0.5, 0.5)])
@pytest.mark.parametrize("arrival", [0.0, 0.05, 0.37, 0.6, 1.0])
def test_the_parabola_has_the_mean_and_two_moments_of_the_input(begin, length, arrival):
    late = Late(*(jnp.array([x]) for x in (1.3, -0.4, 0.7, -1.1, arrival)))
    a, b, c = (float(x[0]) for x in parabola_over_step(late, jnp.asarray(begin), jnp.asarray(length)))
    borders = np.unique(np.clip([0.0, (arrival - begin) / length, 1.0], 0.0, 1.0))
    nodes, weights = np.polynomial.legendre.leggauss(4)
    moments = np.zeros(3)
    for low, high in pairwise(borders):
        s = low + (high - low) * (nodes + 1) / 2
        since = begin + length * s - arrival
        u = np.where(since >= 0, -0.4 - 1.1 * since, 1.3 + 0.7 * since)
        moments += (high - low) / 2 * (weights * u * s ** np.arange(3)[:, None]).sum(axis=1)
    s = (nodes + 1) / 2
    found = (weights / 2 * (a + b * s + c * (6 * s**2 - 6 * s + 1)) * s ** np.arange(3)[:, None]).sum(axis=1)
    np.testing.assert_allclose(found, moments, atol=1e-13)


def moved(delay, ramps, u):
    """(samples,) displacements of one mass, each interval cut where a late sample arrives; delay in intervals."""
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    number = np.arange(len(u))
    x, found = np.zeros(2), []
    for k in number:
        found.append(x[0])
        for begin, end in ((k, k + delay % 1), (k + delay % 1, k + 1)):
            if ramps:
                first, last = np.interp(np.array([begin, end]) - delay, number, u)
            else:
                at = int(np.floor(0.5 * (begin + end) - delay))
                first = last = u[at] if at >= 0 else 0.0
            whole = np.zeros((4, 4))
            whole[:2, :2], whole[1, 2], whole[2, 3] = A, 1 / MASS, 1.0
            x = (
                expm(whole * (end - begin) * DT) @ [*x, first, (last - first) / ((end - begin) * DT or 1.0)]
            )[:2]
    return np.array(found)


@pytest.mark.parametrize(
    ("hold", "delay", "bounds"),
    [
        ("zero", 0.05, (8e-3, 3e-5)),
        ("zero", 0.4, (1.5e-3, 6e-6)),
        ("zero", 1.3, (1.2e-4, 1.3e-6)),
        ("first", 0.05, (3e-4, 2e-6)),
        ("first", 0.4, (2.2e-4, 2.2e-7)),
        ("first", 1.3, (1.1e-4, 1e-7)),
    ],
)
def test_a_late_input_moves_a_body_that_is_sampled_coarsely(hold, delay, bounds):
    """One radian of vibration a sample; next to what the delay does. A line errs 8 to 150 times as much."""
    u = np.random.default_rng(4).standard_normal(200)
    u[:2] = 0.0
    model = lumped_model(
        ["m"],
        [MASS],
        [STIFFNESS],
        [DAMPING],
        connections=[Connection("c", ("ground", "m"))],
        inputs=[Input("f", "m", hold)],
        sensors=[Sensor("x", "m", "displacement")],
    )
    slots = effect_slots(model, (Effect("input_delay", (("input", "f"),), {"delay": delay * DT}),))
    expected, plain = (moved(x, hold == "first", u) for x in (delay, 0.0))
    size = np.sqrt(((expected - plain) ** 2).mean())
    for substeps, least in zip((1, 4), bounds, strict=True):
        given = jnp.asarray(u)[:, None], jnp.array([hold == "first"]), jnp.asarray(DT), jnp.zeros(4)
        found = jax.jit(respond, static_argnums=6)(second_order(model), slots, *given, substeps)
        assert np.sqrt(((found.outputs[:, 0] - expected) ** 2).mean()) < least * size


def test_an_input_that_is_not_late_is_its_hold():
    u = jnp.asarray(np.random.default_rng(5).standard_normal((6, 1)))
    for ramps in (False, True):
        late = late_input(u, jnp.array([ramps]), jnp.zeros(1))
        for k in range(5):
            one = Late(*(x[k] for x in late[:4]), late.arrival)
            a, b, c = parabola_over_step(one, jnp.asarray(0.0), jnp.asarray(1.0))
            np.testing.assert_allclose(
                [a[0], b[0], c[0]], [u[k, 0], ramps * (u[k + 1] - u[k])[0], 0], atol=1e-15
            )
