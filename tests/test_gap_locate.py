"""Places of single effects in records of the reference integration, sets, forces, several records, bad input."""

import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import DT, JOINT, SENSED, WALL, chain, drive, exact, noisy, record, with_effect
from scipy.linalg import expm

from jaxsid.checks import InputError
from jaxsid.gap.locate import locate
from jaxsid.gap.places import Place, joint_of, places_of
from jaxsid.mechanics.lumped import (
    Connection,
    Input,
    Matrices,
    Sensor,
    Tolerance,
    lumped_model,
    second_order,
)
from jaxsid.records import Record

CUBIC = ("cubic_stiffness", JOINT, {"coefficient": 3e6})
B12, B1 = Place("between", ("b1", "b2")), Place("between", ("ground", "b1"))
DRIVE = Place("input", ("drive",))
LONG = [  # for the long run
    ("hysteresis", JOINT, {"stiffness": 800.0, "beta": 60.0, "gamma": 40.0, "exponent": 1.0}, B12),
    ("backlash", (1, 2), {"half_gap": 0.003}, Place("between", ("b2", "b3"))),
    ("actuator_saturation", 0, {"limit": 9.0}, DRIVE),
]
CASES = [
    (*CUBIC, B12),
    ("quadratic_damping", WALL, {"coefficient": 15.0}, B1),
    ("sensor_delay", 1, {"delay": 0.004}, Place("sensor", ("s1",))),
    *(pytest.param(*case, marks=pytest.mark.slow) for case in LONG),
]


def measured(kind, place, parameters, kinds=SENSED, seed=0):
    u = drive(seed=seed)
    return u, noisy(with_effect(u, kind, place, parameters, kinds), seed=seed)


def sliding(mass=95.0, damping=203.0, friction=20.0, dt=0.004, samples=2048, parts=40):
    """Input and position of a body that slides with friction, implicit in its impulse so that rest is rest."""
    t = np.arange(samples) * dt
    push = 60 * np.sin(np.pi * t) + 30 * np.sin(3.4 * np.pi * t + 1) + 20 * np.sign(np.sin(0.46 * np.pi * t))
    kept = np.exp(-damping / mass * dt / parts)
    gain = (1 - kept) / damping
    q, v, found = 0.0, 0.0, []
    for force in push:
        found.append(q)
        for _ in range(parts):
            free = kept * v + gain * force
            after = free - np.clip(free, -gain * friction, gain * friction)
            q, v = q + dt / parts * (v + after) / 2, after
    return push, np.array(found)


def balanced(samples=1024):
    """Push and displacement of an inverted pendulum that a controller holds up, input held over each sample."""
    A, push, found, x = np.array([[0.0, 1.0], [4.0, -0.5]]), drive(samples), [], np.zeros(2)
    step = expm(np.block([[A, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]) * DT)
    for k in range(samples):
        found.append(x[0])
        push[k] -= 40 * x[0] + 9 * x[1]
        x = step[:2, :2] @ x + step[:2, 2] * push[k]
    return push, np.array(found)


@pytest.mark.parametrize(("kind", "place", "parameters", "expected"), CASES)
def test_place_is_found_with_all_sensors(kind, place, parameters, expected):
    found = locate(chain(), record(*measured(kind, place, parameters)))
    assert found.ranked[0].place == expected
    # whatever acts on the driven body may be an error of the drive
    assert set(found.likely) == ({B1, DRIVE} if expected in (B1, DRIVE) else {expected})
    assert found.ranked[0].together == found.likely
    assert found.ranked[0].probability > 0.95
    assert found.ranked[0].across < 1.5


@pytest.mark.slow
def test_place_is_found_with_one_sensor():
    u, y = measured(*CUBIC)
    kinds = SENSED[2:]
    found = locate(chain(kinds), record(u, y[:, 2:], kinds))
    assert B12 in found.likely
    assert len(found.likely) <= 2
    assert np.isnan(found.ranked[0].across)
    assert any("One sensor" in remark for remark in found.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.2, 0.5])
def test_an_input_late_by_part_of_a_sample_is_no_late_accelerometer(part):
    """A held input is read a whole step late by an accelerometer where it acts, however little it is late."""
    kinds = [(0, "acceleration")]
    u, y = measured("input_delay", 0, {"delay": part * DT}, kinds)
    found = locate(chain(kinds), record(u, y, kinds))
    assert found.ranked[0].place == DRIVE
    assert Place("sensor", ("s0",)) not in found.likely


def test_delays_of_one_sensor_and_of_the_input_are_one_set():
    kinds = SENSED[1:2]
    u, y = measured("sensor_delay", 0, {"delay": 0.004}, kinds)
    found = locate(chain(kinds), record(u, y, kinds))
    assert {Place("sensor", ("s1",)), DRIVE} <= set(found.likely)
    assert len({x.probability for x in found.ranked if x.place in (Place("sensor", ("s1",)), DRIVE)}) == 1


@pytest.mark.parametrize("noise", [1e-6, 1e-4])
def test_friction_of_a_free_axis_is_no_cancelled_input(noise):
    """An input cancelled whole, with mass and damper next to zero, explains every record, and is no explanation."""
    push, slide = sliding()
    y = slide + noise * slide.std() * np.random.default_rng(0).standard_normal(len(slide))
    model = lumped_model(
        ["b1"],
        [96.0],
        [0.0],
        [200.0],
        connections=[Connection("guide", ("ground", "b1"))],
        inputs=[Input("drive", "b1")],
        sensors=[Sensor("q", "b1", "displacement")],
        tolerance=Tolerance(0.05, 0.05, 0.3),
    )
    found = locate(model, Record(push[:, None], y[:, None], 0.004, inputs=("drive",), outputs=("q",)))
    assert found.ranked[0].place == B1
    assert set(found.likely) == {B1, DRIVE}
    fast = np.abs(found.maps[0].velocity) > 0.1 * found.maps[0].velocity.std()
    friction = -20.0 * np.sign(found.maps[0].velocity)
    assert np.corrcoef(found.maps[0].force[fast], friction[fast])[0, 1] > 0.9


def test_force_is_that_of_the_law():
    """Cubic stiffness: the force on the second end is -p d^3."""
    # accelerometers do not tell a steady force
    kinds = tuple((body, "displacement") for body, _ in SENSED)
    u, y = measured(*CUBIC, kinds)
    found = locate(chain(kinds), record(u, y, kinds)).maps[0]
    inner = slice(100, -100)
    expected = -3e6 * found.displacement**3
    error = (found.force - expected)[inner]
    assert np.sqrt((error**2).mean()) < 0.2 * expected.std()
    assert 0 < found.deviation < 0.3 * expected.std()


@pytest.mark.slow
def test_error_of_a_sensor_of_an_unstable_model_is_followed():
    model = lumped_model(
        ["m"],
        matrices=Matrices(*(jnp.array([[x]]) for x in (1.0, 0.5, -4.0))),
        inputs=[Input("drive", "m")],
        sensors=[Sensor("s0", "m", "displacement"), Sensor("s1", "m", "displacement")],
    )
    u, y = balanced()
    error = 0.05 * y.std() * np.convolve(drive(len(y), seed=7), np.hanning(40) / 40, "same")
    measured = noisy(np.stack([y + error, y], axis=1))
    found = locate(model, record(u, measured, kinds=((0, "displacement"), (1, "displacement"))))
    assert found.likely == (Place("sensor", ("s0",)),)
    (one,) = found.maps
    assert np.sqrt(np.mean((one.force - error) ** 2)) < 0.1 * error.std()


@pytest.mark.slow
def test_records_that_each_hold_some_sensors():
    parts = []
    for seed, sensors in ((0, (0, 2)), (1, (1,))):
        u, y = measured(*CUBIC, seed=seed)
        kinds = tuple(SENSED[i] for i in sensors)
        parts.append(record(u, y[:, list(sensors)], kinds))
    found = locate(chain(), parts)
    assert found.ranked[0].place == B12
    assert {m.record for m in found.maps} == {0, 1}


@pytest.mark.slow
def test_units_do_not_matter():
    """Grams instead of kilograms: the same probabilities."""
    u, y = measured(*CUBIC)
    plain = chain()
    small = lumped_model(
        plain.bodies,
        1000 * plain.mass,
        1000 * plain.stiffness,
        1000 * plain.damping,
        connections=plain.connections,
        inputs=plain.inputs,
        sensors=plain.sensors,
    )
    one, other = locate(plain, record(u, y)), locate(small, record(1000 * u, y))
    assert [x.place for x in one.ranked[:2]] == [x.place for x in other.ranked[:2]]
    assert abs(one.ranked[1].evidence - other.ranked[1].evidence) < 0.01 * abs(one.ranked[1].evidence)


def test_places_of_a_chain_and_of_its_matrices():
    plain = chain()
    places = places_of(plain)
    assert len(places) == 10
    assert [p.ends for p in places[:3]] == [c.between for c in plain.connections]
    whole = second_order(plain)
    given = lumped_model(
        plain.bodies,
        matrices=Matrices(whole.mass, whole.damping, whole.stiffness),
        inputs=plain.inputs,
        sensors=plain.sensors,
    )
    assert set(places_of(given)) == set(places)
    assert joint_of(plain, B12).tolist() == [-1.0, 1.0, 0.0]
    assert places[-1].as_dict() == {"input": "drive"}
    assert B12.as_dict() == {"between": ["b1", "b2"]}


def test_two_connections_between_the_same_ends_are_one_place():
    twice = lumped_model(
        ["a"],
        [1.0],
        [1.0, 2.0],
        [0.0, 0.1],
        connections=[Connection("x", ("ground", "a")), Connection("y", ("a", "ground"))],
    )
    assert [p.ends for p in places_of(twice)] == [("ground", "a")]


def test_large_models_have_no_pairs_of_distant_bodies():
    names = [f"b{i}" for i in range(12)]
    ends = ["ground", *names]
    big = lumped_model(
        names,
        np.ones(12),
        np.ones(12),
        np.ones(12),
        connections=[Connection(f"c{i}", ends[i : i + 2]) for i in range(12)],
    )
    pairs = {p.ends for p in places_of(big)}
    assert ("b0", "b2") in pairs
    assert ("b0", "b7") not in pairs
    assert ("ground", "b7") in pairs


def test_bad_input():
    u = drive(300)
    with pytest.raises(InputError, match="at least one record"):
        locate(chain(), [])
    with pytest.raises(InputError, match="as many noises"):
        locate(chain(), record(u, exact(u)), noises=())
    other = chain(kinds=((0, "acceleration"),))
    with pytest.raises(InputError, match="none of the model's sensors"):
        locate(other, record(u, exact(u)[:, 1:], SENSED[1:]))
