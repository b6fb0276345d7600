"""Scales and priors of every kind's parameters: they are there, they follow the units, they are distributions."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsid
from jaxsid.examples import systems
from jaxsid.mechanics.amplitudes import amplitudes
from jaxsid.mechanics.effects.catalogue import CATALOGUE, scales
from jaxsid.mechanics.effects.kind import Motion, Nominal
from jaxsid.mechanics.effects.prior import Amplitudes, Prior, Scale
from jaxsid.mechanics.lumped import Connection, Effect, Input, second_order
from jaxsid.mechanics.slots import nominal_at, slots_of

LENGTH, FORCE, TIME, READING = 1e3, 2.0, 7.0, 5.0  # of new units in the old ones, inverse
AT = Amplitudes(*(jnp.asarray(x) for x in (3.0, 0.02, 0.4, 1.7, 18.0, 10.0)))
MOTION = Motion(*(jnp.asarray([x, -x]) for x in (0.03, 0.5, 0.01, 2.0, 600.0)))
POWERS = {"exponent": jnp.asarray(1.7)}


def in_new_units(at):
    """Amplitudes where numbers of lengths, forces and times are larger by these factors."""
    speed = LENGTH / TIME
    factors = (FORCE, LENGTH, speed, READING, 1 / TIME, TIME)
    return Amplitudes(*(x * f for x, f in zip(at, factors, strict=True)))


def values(kind, at):
    """Every parameter at 0.7 of its scale; an exponent as it is."""
    return [
        POWERS.get(p.name, 0.7 * s)
        for p, s in zip(kind.parameters, scales(kind.name, at, POWERS), strict=True)
    ]


@pytest.mark.parametrize("name", CATALOGUE)
def test_laws_see_no_units(name):
    """Parameters at their scales do alike whatever the units, so each scale has the unit of its parameter."""
    kind, new = CATALOGUE[name], in_new_units(AT)
    factors = (LENGTH, LENGTH / TIME, LENGTH, TIME, FORCE / LENGTH)
    moved = Motion(*(x * f for x, f in zip(MOTION, factors, strict=True)))
    old, now = values(kind, AT), values(kind, new)
    speed = jnp.abs(MOTION.velocity)
    pairs = []
    if kind.force is not None:
        pairs.append((kind.force(MOTION, *old) * FORCE, kind.force(moved, *now)))
    if kind.rate is not None:
        pairs.append((kind.rate(MOTION, *old) * LENGTH / TIME, kind.rate(moved, *now)))
    if kind.slip is not None:
        pairs.append((kind.slip(speed, *old) * FORCE, kind.slip(speed * LENGTH / TIME, *now)))
    if kind.changes is not None:
        heavy, rubbing, stiff = FORCE * TIME**2 / LENGTH, FORCE * TIME / LENGTH, FORCE / LENGTH
        nominal = Nominal(jnp.asarray(2.0), jnp.asarray(3.0), jnp.asarray(4.0))
        there = Nominal(*(x * f for x, f in zip(nominal, (heavy, rubbing, stiff), strict=True)))
        factors = (heavy, rubbing, stiff) * 2 + (1.0, READING, TIME, TIME, 1 / READING)
        found = zip(kind.changes(nominal, *old), kind.changes(there, *now), factors, strict=True)
        pairs += [(x * f, y) for x, y, f in found]
    for expected, found in pairs:
        np.testing.assert_allclose(found, expected, rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("prior", sorted({p.prior for kind in CATALOGUE.values() for p in kind.parameters}))
def test_priors_are_distributions(prior):
    steps = 200_001
    low, high = prior.lowest, prior.highest
    x = jnp.geomspace(low, high, steps) if prior.shape == "log-normal" else jnp.linspace(low, high, steps)
    density = np.exp(np.asarray(jax.vmap(prior.log_density)(x)))
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-6)
    assert prior.log_density(jnp.asarray(high + 1.0)) == -np.inf
    assert np.isfinite(jax.grad(prior.log_density)(jnp.asarray(0.5 * (low + high))))
    assert str(prior)


def test_priors_keep_to_what_makes_sense():
    for kind in CATALOGUE.values():
        for p in kind.parameters:
            assert p.prior.lowest >= p.lowest, f"{kind.name}.{p.name}"
            assert p.raised is None or p.raised in {q.name for q in kind.parameters}


def test_scales_in_symbols():
    assert str(Scale(force=1, displacement=-3)) == "F d⁻³"
    assert str(Scale()) == ""
    assert str(Prior("uniform", 0.0, 1.0, -1.0, 1.0)) == "-1 to 1"


def test_amplitudes_of_places():
    """A joint carries its spring's and damper's force, or what accelerates its ends if that is more."""
    model = systems.three_dof()
    bodies = model.bodies
    places = [
        ("coulomb_friction", (("between", (bodies[0], bodies[1])),), {"force": 1.0}),
        ("coulomb_friction", (("between", (bodies[0], bodies[2])),), {"force": 1.0}),
        ("constant_load", (("body", bodies[1]),), {"force": 1.0}),
        ("sensor_bias", (("sensor", model.sensors[0].name),), {"offset": 1.0}),
        ("input_gain", (("input", model.inputs[0].name),), {"factor": 1.0}),
    ]
    effects = [Effect(k, p, {n: jnp.asarray(v) for n, v in q.items()}) for k, p, q in places]
    slots = slots_of(
        jaxsid.lumped_model(
            bodies, model.mass, model.stiffness, model.damping, connections=model.connections,
            inputs=model.inputs, sensors=model.sensors, effects=effects,
        )
    )  # fmt: skip
    linear, rng = second_order(model), np.random.default_rng(0)
    x, v = rng.normal(size=(2, 400, len(bodies)))
    u, y = rng.normal(size=(400, len(model.inputs))), rng.normal(size=(400, len(model.sensors)))
    found = amplitudes(linear, slots, *(jnp.asarray(a) for a in (x, v, u, y)), 0.05)
    M, D, K = (np.asarray(a) for a in (linear.mass, linear.damping, linear.stiffness))
    rms = lambda a: np.sqrt((a**2).mean())  # noqa: E731
    net = u @ np.asarray(linear.input_matrix).T - x @ K.T - v @ D.T
    assert not K[0, 2]
    assert not D[0, 2]
    across = -K[0, 1] * (x[:, 1] - x[:, 0]) - D[0, 1] * (v[:, 1] - v[:, 0])
    shared = [rms(net[:, j] - net[:, 0]) / 2 for j in (1, 2)]
    expected = [max(rms(across), shared[0]), shared[1], rms(net[:, 1])]
    np.testing.assert_allclose(found.force[:3], expected)
    np.testing.assert_allclose(found.displacement[0], rms(x[:, 1] - x[:, 0]))
    np.testing.assert_allclose(found.velocity[2], rms(v[:, 1]))
    np.testing.assert_allclose(found.signal[3:], [rms(y[:, 0]), rms(u[:, 0])])
    slowest = np.sqrt(np.linalg.eigvals(np.linalg.solve(M, K)).real.min())
    np.testing.assert_allclose(found.rate, slowest)


def test_a_light_bearing_may_rub_far_more_than_it_carries():
    """A servo motor's bearing drags little at any speed; what could rub there is a part of what drives the motor."""
    bearing = [Connection("bearing", ("ground", "motor")), Connection("gear", ("motor", "load"))]
    torque = [Input("torque", "motor")]
    model = jaxsid.lumped_model(
        ["motor", "load"], [0.005, 0.2], [0.0, 9e3], [0.4, 0.8], connections=bearing, inputs=torque
    )
    rubs = Effect("coulomb_friction", (("between", ("ground", "motor")),), {"force": 1.0})
    slots = slots_of(dataclasses.replace(model, effects=(rubs,)))
    v = jnp.asarray(0.1 * np.random.default_rng(0).standard_normal((300, 1))) * jnp.ones(2)
    force = amplitudes(second_order(model), slots, 0 * v, v, 3 * jnp.ones((300, 1)), v[:, :0], 1e-3).force
    assert float(force[0]) == pytest.approx(3.0, rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_what_rounding_leaves_joins_nothing(seed):
    """Springs of a body add up to none but for rounding where none of them goes to the ground."""
    rng = np.random.default_rng(seed)
    bodies = [f"b{i}" for i in range(6)]
    stiffness, damping = rng.uniform(0.1, 9e3, 6), rng.uniform(0.01, 9.0, 6)
    chain = [Connection(f"c{i}", ends) for i, ends in enumerate(pairwise(["ground", *bodies]))]
    push = [Input("push", "b0")]
    model = jaxsid.lumped_model(bodies, np.ones(6), stiffness, damping, connections=chain, inputs=push)
    ends = [("ground", b) for b in bodies]
    effects = [Effect("coulomb_friction", (("between", x),), {"force": 1.0}) for x in ends]
    slots = slots_of(dataclasses.replace(model, effects=tuple(effects)))
    found = nominal_at(slots, second_order(model))
    assert float(found.stiffness[0]) == pytest.approx(stiffness[0], rel=1e-9)
    assert float(found.damping[0]) == pytest.approx(damping[0], rel=1e-9)
    assert not np.asarray(found.stiffness[1:]).any()
    assert not np.asarray(found.damping[1:]).any()
    q, v = jnp.asarray(np.random.default_rng(0).standard_normal((2, 100, 6)))
    force = amplitudes(second_order(model), slots, q, v, jnp.ones((100, 1)), q[:, :0], 0.01).force
    assert (np.asarray(force) > 1e-2).all()
