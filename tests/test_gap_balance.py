"""Balance on free bodies: noise alone gives what chance does, steady forces and offsets are found and measured."""

import numpy as np
import pytest
from gap_bench import known
from gap_helpers import chain
from gap_helpers import record as held_record
from scipy.linalg import expm

from jaxsid.gap.balance import _missing, balance_of
from jaxsid.gap.null import _steady, null_test
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import as_given, recalibrated
from jaxsid.mechanics.lumped import Connection, Input, Sensor, free_bodies, lumped_model, second_order
from jaxsid.records import Record

DT, SAMPLES, NOISE = 0.01, 1000, 1e-3
SPEEDS = (("b1", "velocity"), ("b2", "velocity"))
MIXED = (("b1", "displacement"), ("b2", "acceleration"))


def axis(sensors=SPEEDS, drag=0.0, hold="zero"):
    """Two bodies that a spring joins, and that nothing but a damper holds."""
    more = [Connection("drag", ("ground", "b1"))] if drag else []
    return lumped_model(
        ["b1", "b2"],
        [1.0, 2.0],
        [300.0, 0.0][: 1 + len(more)],
        [0.5, drag][: 1 + len(more)],
        connections=[Connection("joint", ("b1", "b2")), *more],
        inputs=[Input("drive", "b1", hold)],
        sensors=[Sensor(f"{body} {kind}", body, kind) for body, kind in sensors],
    )


def readings(model, force, seed=0, start=(0.1, -0.2, 0.3, 0.1)):
    """Of the exact motion under a random push on the first body and a steady force on the second."""
    plain = second_order(model)
    M, D, K = (np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness))
    solve = lambda x: -np.linalg.solve(M, x)  # noqa: E731
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [solve(K), solve(D)]])
    B = np.concatenate([np.zeros((2, 2)), np.diag(1 / np.diag(M))])
    # what pushes ramps from one sample to the next where the hold is of first order
    ramp = np.block([[A, B, np.zeros((4, 2))], [np.zeros((2, 6)), np.eye(2) / DT], [np.zeros((2, 8))]])
    step = expm(ramp * DT)
    pushes = np.column_stack([np.random.default_rng(seed).standard_normal(SAMPLES), np.full(SAMPLES, force)])
    sensed = [
        np.asarray(x)
        for x in (plain.displacement_sensors, plain.velocity_sensors, plain.acceleration_sensors)
    ]
    follow = np.append(pushes[1:], pushes[-1:], axis=0) - pushes
    if model.inputs[0].hold == "zero":
        follow = 0 * follow
    x, y = np.array(start), []
    for push, change in zip(pushes, follow, strict=True):
        y.append(sensed[0] @ x[:2] + sensed[1] @ x[2:] + sensed[2] @ (A @ x + B @ push)[2:])
        x = step[:4] @ np.concatenate([x, push, change])
    return pushes[:, :1], np.array(y)


def fitted(model, force, seed=0, offset=0.0):
    """The model refitted within its tolerance to a record with white noise of a known level, the last sensor off."""
    u, y = readings(model, force, seed)
    y[:, -1] += offset
    level = NOISE * np.ones(y.shape[1])
    y = y + level * np.random.default_rng(100 + seed).standard_normal(y.shape)
    data = Record(u, y, DT, inputs=("drive",), outputs=tuple(s.name for s in model.sensors))
    noise = known(level)
    noise.taps[:, 1:] = 0.0
    return recalibrated(model, [data], [noise], wide=False)


@pytest.mark.parametrize(
    "model",
    [
        axis(),
        pytest.param(axis(drag=0.3), marks=pytest.mark.slow),
        axis(MIXED),
        pytest.param(axis(MIXED, 0.3), marks=pytest.mark.slow),
        axis(MIXED, hold="first"),
    ],
    ids=["free", "dragged", "mixed", "both", "ramps"],
)
def test_noise_alone_gives_what_chance_does(model):
    fits = [fitted(model, 0.0, seed) for seed in range(16)]
    statistics = [balance_of(x, x.settings)[0].statistic for x in fits]
    # the mean of 16 squares of standard normal numbers: 1 +- 0.35
    assert 0.3 < np.mean(statistics) < 2.2
    assert max(statistics) < 12


@pytest.mark.parametrize(
    "model",
    [axis(), axis(drag=0.3), axis(MIXED), axis(MIXED, hold="first")],
    ids=["free", "dragged", "mixed", "ramps"],
)
def test_a_steady_force_is_found_and_measured(model):
    fit = fitted(model, 0.02)
    found = _steady(fit, fit.settings)[0]
    assert found.p_value < 1e-6
    part = _missing(fit.settings[0], fit.linear[0], free_bodies(fit.model)).force
    deviation = np.sqrt(part.covariance + part.slopes @ fit.covariance @ part.slopes.T)[0, 0]
    assert abs(part.values[0] - 0.02) < 4 * deviation < 0.01
    assert null_test(fit, places_of(fit.model)).p_value < 1e-4


def test_its_share_is_that_of_what_it_does_to_the_sensors():
    model = axis()
    with_force, without = (readings(model, force)[1] for force in (0.05, 0.0))
    change = (with_force - without) - (with_force - without).mean(axis=0)
    expected = np.sqrt(
        ((change**2).sum(axis=0) / ((with_force - with_force.mean(axis=0)) ** 2).sum(axis=0)).mean()
    )
    fit = fitted(model, 0.05)
    assert balance_of(fit, fit.settings)[0].share == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("model", "count"),
    [
        (axis(), 1),
        pytest.param(axis(drag=0.3), 1, marks=pytest.mark.slow),
        (axis((("b1", "displacement"), ("b2", "displacement"))), 1),
        pytest.param(axis(MIXED), 1, marks=pytest.mark.slow),
        pytest.param(axis((("b2", "displacement"), *SPEEDS)), 2, marks=pytest.mark.slow),
        (axis((("b1", "velocity"),)), 0),
    ],
    ids=["speeds", "dragged", "displacements", "acceleration", "three", "one"],
)
def test_offsets_are_found_where_the_motion_cannot_take_them_up(model, count):
    statistics = []
    for seed in range(16):
        fit = fitted(model, 0.0, seed)
        means = balance_of(fit, fit.settings)[1]
        assert means.count == count
        statistics.append(means.statistic)
    if not count:
        assert len(_steady(fit, fit.settings)) == 1
        return
    assert 0.3 < np.mean(statistics) < 2.2
    # of 1000 samples the mean of one sensor, or of two less each other, is known to a thirtieth or so of the noise
    fit = fitted(model, 0.0, offset=0.5 * NOISE)
    found = _steady(fit, fit.settings)[1]
    assert found.p_value < 1e-6
    part = _missing(fit.settings[0], fit.linear[0], free_bodies(fit.model))
    # two alike share what is between them
    alike = sum(s.name.split()[1] == model.sensors[-1].name.split()[1] for s in model.sensors)
    expected = 0.5 * NOISE / (alike if count == 1 else 1)
    assert abs(part.offsets[-1]) == pytest.approx(expected, rel=0.35)
    assert null_test(fit, places_of(fit.model)).p_value < 1e-4


def test_nothing_to_balance_where_bodies_are_held():
    model = chain()
    data = held_record(np.zeros(256), np.random.default_rng(0).standard_normal((256, 3)))
    fit = as_given(model, [data], [known(np.ones(3))])
    assert balance_of(fit, fit.settings) is None
