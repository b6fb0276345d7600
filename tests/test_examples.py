"""The reference systems, their excitation and their records against closed forms and other integrators."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxsid import examples
from jaxsid.checks import InputError, check_excitation, check_record
from jaxsid.examples.twin import BEARING_DAMPING
from jaxsid.mechanics.lumped import second_order


def poles(model):
    so = second_order(model)
    mass, damping, stiffness = (np.asarray(x) for x in (so.mass, so.damping, so.stiffness))
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    n = len(mass)
    values = np.linalg.eigvals(np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower]))
    return np.sort_complex(values[values.imag >= 0])


def rms(x):
    return np.sqrt(np.mean(np.square(x)))


# --- systems


def test_one_dof():
    np.testing.assert_allclose(poles(examples.one_dof()), [-0.005 + 1j * np.sqrt(1 - 0.005**2)], rtol=1e-12)


def test_three_dof():
    so = second_order(examples.three_dof())
    np.testing.assert_allclose(so.stiffness, [[4, -2, 0], [-2, 4, -2], [0, -2, 22]], rtol=1e-14)
    np.testing.assert_allclose(so.damping, [[0.2, -0.1, 0], [-0.1, 0.2, -0.1], [0, -0.1, 1.1]], atol=1e-15)
    np.testing.assert_allclose(so.mass, np.eye(3))
    published = [-0.5556 + 4.681j, -0.1470 + 2.420j, -0.04745 + 1.377j]
    np.testing.assert_allclose(poles(examples.three_dof()), published, rtol=3e-4)


def test_rig():
    np.testing.assert_allclose(
        poles(examples.rig()), [-120.217 + 1343.273j, -4.92978, 0], rtol=1e-6, atol=1e-9
    )


def test_nominal_rig_is_wrong_within_its_tolerance():
    nominal, rig = examples.rig_model_nominal(), examples.rig()
    for what in ("mass", "stiffness", "damping"):
        true, guess = np.asarray(getattr(rig, what)), np.asarray(getattr(nominal, what))
        error = np.abs(guess - true)[true > 0] / true[true > 0]
        assert error.max() > 0.1
        assert error.max() < 2 * getattr(nominal.tolerance, what)


def test_sensor_kinds_are_chosen():
    assert examples.one_dof(sensor="velocity").sensors[0].kind == "velocity"
    kinds = ("displacement", "velocity", "acceleration")
    assert tuple(s.kind for s in examples.three_dof(sensors=kinds).sensors) == kinds


# --- excitation


def test_chirp_is_scipys():
    u = examples.chirp(0.1, 10.0, duration=10.0, dt=1e-3, samples=4096, amplitude=2.0)
    expected = 2 * scipy.signal.chirp(np.arange(4096) * 1e-3, 0.1, 10.0, 10.0, phi=-90)
    assert u[0] == 0
    np.testing.assert_allclose(u, expected, atol=1e-11)
    assert len(examples.chirp(0.1, 10.0, duration=10.0, dt=1e-3)) == 10000


def test_stepped_sine_counts_every_cycle():
    u = examples.stepped_sine(5.0, 7.0, step=0.5, cycles=3, dt=1e-4, amplitude=2.0, rest=10)
    assert not u[:10].any()
    assert np.sum((u[10:-1] <= 0) & (u[11:] > 0)) == 3 * 5
    assert len(u) == 10 + np.ceil(3e4 * sum(1 / f for f in (5.0, 5.5, 6.0, 6.5, 7.0)))
    np.testing.assert_allclose(u.max(), 2.0, rtol=1e-5)
    assert np.abs(np.diff(u)).max() < 2 * np.pi * 7.0 * 2.0 * 1e-4


def test_rig_torque_has_the_published_length():
    u = examples.rig_torque()
    assert len(u) == 92108
    power = np.abs(np.fft.rfft(u)) ** 2
    frequency = np.fft.rfftfreq(len(u), 1e-3)
    assert power[(frequency > 19) & (frequency < 351)].sum() > 0.995 * power.sum()


@pytest.mark.parametrize(
    "make",
    [
        lambda: examples.chirp(0.1, 501.0, duration=1.0, dt=1e-3),
        lambda: examples.chirp(0.1, 10.0, duration=0.0, dt=1e-3),
        lambda: examples.stepped_sine(30.0, 20.0, step=0.5, cycles=16, dt=1e-3),
        lambda: examples.stepped_sine(20.0, 30.0, step=0.0, cycles=16, dt=1e-3),
        lambda: examples.stepped_sine(20.0, 30.0, step=1.0, cycles=1, dt=0.0),
    ],
)
def test_excitation_refuses(make):
    with pytest.raises(InputError):
        make()


# --- exact records


def test_exact_record_of_a_step_is_the_closed_form():
    dt, n = 0.05, 400
    t = np.arange(n) * dt
    wd = np.sqrt(1 - 0.005**2)
    decay = np.exp(-0.005 * t)
    closed = {
        "displacement": 1 - decay * (np.cos(wd * t) + 0.005 / wd * np.sin(wd * t)),
        "velocity": decay * np.sin(wd * t) / wd,
        "acceleration": decay * (np.cos(wd * t) - 0.005 / wd * np.sin(wd * t)),
    }
    for kind, expected in closed.items():
        record = examples.exact_record(examples.one_dof(sensor=kind), np.ones(n), dt)
        np.testing.assert_allclose(record.y[:, 0], expected, atol=1e-12)


def test_exact_record_is_scipys_for_every_kind():
    model = examples.three_dof(sensors=("displacement", "velocity", "acceleration"))
    u = np.random.default_rng(1).standard_normal((300, 3))
    so = second_order(model)
    lower = -np.hstack([so.stiffness, so.damping])
    A = np.vstack([np.hstack([np.zeros((3, 3)), np.eye(3)]), lower])
    B = np.vstack([np.zeros((3, 3)), np.eye(3)])
    C = np.vstack([np.eye(6)[[0, 4]], lower[2]])
    D = np.vstack([np.zeros((2, 3)), np.eye(3)[2]])
    _, expected, _ = scipy.signal.dlsim(scipy.signal.cont2discrete((A, B, C, D), 0.03), u)
    np.testing.assert_allclose(examples.exact_record(model, u, 0.03).y, expected, atol=1e-11)


def test_three_dof_records_add_up():
    records = examples.three_dof_records(samples=500)
    assert [r.inputs for r in records] == [("force1",), ("force2",), ("force3",)]
    together = examples.exact_record(examples.three_dof(), np.hstack([r.u for r in records]), 1e-3)
    np.testing.assert_allclose(sum(r.y for r in records), together.y, atol=1e-13)


def test_records_pass_the_library_checks():
    for record in (examples.one_dof_record(), *examples.three_dof_records()):
        check_record(record)
        check_excitation(record)
        assert record.u.shape == (4096, 1)


def test_records_in_single_precision(single_precision):
    record = examples.one_dof_record(samples=50)
    assert record.y.dtype == jnp.float32
    assert bool(jnp.isfinite(record.y).all())


def test_exact_record_refuses():
    model = examples.three_dof()
    with pytest.raises(InputError, match="not among"):
        examples.exact_record(model, np.ones(5), 1e-3, inputs=("shaker",))
    with pytest.raises(InputError, match="columns"):
        examples.exact_record(model, np.ones(5), 1e-3)


# --- the rig's twin


@pytest.fixture(scope="module")
def clean():
    return examples.rig_record(0, gyro_noise=0.0, torque_noise=0.0, resolver_bits=None)


@pytest.fixture(scope="module")
def noisy():
    return examples.rig_record(0)


def test_twin_without_noise_is_the_rig_under_its_effective_torque(clean):
    expected = examples.exact_record(examples.rig(), clean.u, 1e-3)
    assert expected.outputs == clean.outputs
    np.testing.assert_allclose(clean.y, expected.y, atol=1e-9)


def test_twin_noise_is_as_stated(clean, noisy):
    gyro = np.asarray(noisy.y - clean.y)[:, 1]
    torque = np.asarray(noisy.u - clean.u)[:, 0]
    assert rms(gyro) / rms(clean.y[:, 1]) == pytest.approx(0.01, rel=0.02)
    assert rms(torque) / rms(clean.u) == pytest.approx(0.005, rel=0.02)
    for noise in (gyro, torque):
        assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.02
    assert abs(np.corrcoef(gyro, torque)[0, 1]) < 0.02


def test_resolver_reads_whole_bits(clean, noisy):
    bit = 2 * 125 * 2 * np.pi / 10 / 2**16
    words = np.asarray(noisy.y[:, 0]) / bit
    np.testing.assert_allclose(words, np.round(words), atol=1e-8)
    assert rms(noisy.y[:, 0] - clean.y[:, 0]) == pytest.approx(bit / np.sqrt(12), rel=0.05)


def test_torque_is_disturbed_around_the_anti_resonance_only(clean):
    demand, torque = examples.rig_torque(), np.asarray(clean.u[:, 0])
    end = 93e-3 + np.cumsum(16 / (20 + 0.5 * np.arange(661)))

    def gain(frequency):
        i = round((frequency - 20) / 0.5)
        part = slice(round(1e3 * (end[i] - 8 / frequency)), round(1e3 * end[i]))
        return rms(torque[part]) / rms(demand[part])

    assert gain(34.0) < 0.9
    assert gain(40.0) > 1.1
    assert gain(100.0) == pytest.approx(1, abs=0.03)
    assert gain(300.0) == pytest.approx(1, abs=0.03)


def test_twin_repeats_by_seed():
    demand = examples.rig_torque()[:200]
    first, again, other = (examples.rig_record(seed, demand=demand) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.y, again.y)
    np.testing.assert_array_equal(first.u, again.u)
    assert (np.asarray(first.y) != np.asarray(other.y)).any()
    generator = examples.rig_record(np.random.default_rng(3), demand=demand)
    np.testing.assert_array_equal(first.u, generator.u)


def test_friction_sticks_below_its_torque():
    record = examples.rig_record(
        0, demand=np.full(300, 0.3), friction=0.35, gyro_noise=0.0, resolver_bits=None
    )
    np.testing.assert_allclose(record.y, 0, atol=1e-15)


def test_friction_brakes_a_steady_rotation():
    demand = np.full(4000, 2.0)
    record = examples.rig_record(
        0, demand=demand, friction=0.35, substeps=1, gyro_noise=0.0, resolver_bits=None
    )
    np.testing.assert_allclose(record.y[-1], (2.0 - 0.35) / sum(BEARING_DAMPING), rtol=1e-6)


def test_friction_converges_with_the_substeps():
    def response(substeps):
        record = examples.rig_record(
            0,
            demand=examples.rig_torque()[:3000],
            friction=0.35,
            substeps=substeps,
            gyro_noise=0.0,
            resolver_bits=None,
        )
        return np.asarray(record.y)

    fine, default, coarse = response(160), response(20), response(5)
    assert rms(default - fine) < 3e-4 * rms(fine)
    assert rms(default - fine) < 0.1 * rms(coarse - fine)


@pytest.mark.parametrize(
    "wrong",
    [
        {"gyro_noise": -1.0},
        {"friction": -0.1},
        {"resolver_bits": 0},
        {"substeps": 0},
        {"demand": np.ones((5, 1))},
    ],
)
def test_twin_refuses(wrong):
    with pytest.raises(InputError):
        examples.rig_record(0, **wrong)
