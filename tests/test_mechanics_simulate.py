"""Simulation against scipy.signal.lsim, closed forms and dense sums."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from jaxsid.checks import InputError
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import Connection, Input, Sensor, lumped_model, second_order
from jaxsid.mechanics.simulate import (
    estimate_initial_state,
    impulse_response_of,
    markov_parameters,
    simulate,
    simulate_linear,
)
from jaxsid.records import Record

ENDS = ("ground", "a", "b", "c", "ground")


def chain(kinds=("acceleration", "velocity", "displacement"), hold="zero"):
    return lumped_model(
        "abc",
        [1.0, 1.0, 1.0],
        [2.0, 2.0, 2.0, 20.0],
        [0.1, 0.1, 0.1, 1.0],
        connections=[Connection(f"k{i}", ENDS[i : i + 2]) for i in range(4)],
        inputs=[Input(f"f{b}", b, hold) for b in "abc"],
        sensors=[Sensor(f"s{b}", b, kind) for b, kind in zip("abc", kinds, strict=True)],
    )


def rig():
    return lumped_model(
        ("motor", "load"),
        [0.0053, 0.18],
        [9365.0, 0.0, 0.0],
        [0.8268, 0.4352, 0.4782],
        connections=[
            Connection("gearbox", ("motor", "load")),
            Connection("m", ("ground", "motor")),
            Connection("l", ("ground", "load")),
        ],
        inputs=[Input("torque", "motor")],
        sensors=[Sensor("vm", "motor", "velocity"), Sensor("vl", "load", "velocity")],
    )


def continuous_of(model):
    return physical_displacement_velocity(second_order(model))


def noise(samples, inputs, seed=0):
    return np.random.default_rng(seed).normal(size=(samples, inputs))


@pytest.mark.parametrize("model", [chain(), rig()], ids=["chain", "rig"])
@pytest.mark.parametrize("hold", ["zero", "first"])
def test_agrees_with_lsim(model, hold):
    m, dt = continuous_of(model), 1e-3
    u, x0 = noise(1000, m.B.shape[1]), 0.1 * noise(1, len(m.A))[0]
    y = simulate_linear(m, u, dt, hold=hold, initial_state=x0)
    system = tuple(np.asarray(x) for x in (m.A, m.B, m.C, m.D))
    _, truth, _ = scipy.signal.lsim(system, u, dt * np.arange(1000), x0, interp=hold == "first")
    np.testing.assert_allclose(y, truth, atol=1e-11 * np.abs(truth).max())


@pytest.mark.parametrize("samples", [1, 2, 63, 64, 65, 130])
def test_realization_runs_as_its_recursion(samples):
    r = discretise(continuous_of(chain()), 0.05, hold=("zero", "first", "zero"))
    u, x = noise(samples, 3), noise(1, 6)[0]
    y = np.asarray(simulate_linear(r, u, initial_state=x))
    for k in range(samples):
        np.testing.assert_allclose(y[k], np.asarray(r.C) @ x + np.asarray(r.D) @ u[k], atol=1e-12)
        x = np.asarray(r.A) @ x + np.asarray(r.B) @ u[k]


def test_mixed_holds_add_up():
    m, u = continuous_of(chain()), noise(200, 3)
    mixed = simulate_linear(m, u, 0.02, hold=("first", "zero", "first"))
    first, zero = u.copy(), u.copy()
    first[:, 1], zero[:, [0, 2]] = 0, 0
    parts = simulate_linear(m, first, 0.02, hold="first") + simulate_linear(m, zero, 0.02)
    np.testing.assert_allclose(mixed, parts, atol=1e-13)


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_markov_parameters_of_the_reference_system(hold):
    m = continuous_of(chain())
    ir = impulse_response_of(m, 1e-3, samples=4096, hold=hold)
    assert ir.h.shape == (4096, 3, 3)
    r = discretise(m, 1e-3, hold=hold)
    B, C = np.asarray(r.B), np.asarray(r.C)
    np.testing.assert_array_equal(ir.h[0], np.asarray(r.D))
    for k in (1, 2, 63, 64, 65, 1000, 4095):
        truth = C @ scipy.linalg.expm(np.asarray(m.A) * 1e-3 * (k - 1)) @ B
        np.testing.assert_allclose(ir.h[k], truth, atol=1e-12 * np.abs(ir.h).max(), rtol=0)


def test_one_degree_of_freedom_in_closed_form():
    model = lumped_model(
        "a",
        [1.0],
        [1.0],
        [0.01],
        connections=[Connection("k", ("ground", "a"))],
        inputs=[Input("f", "a")],
        sensors=[Sensor("x", "a", "displacement"), Sensor("acc", "a", "acceleration")],
    )
    y = simulate(model, {"f": np.ones(50_000)}, dt=1e-3)
    t, w = 1e-3 * np.arange(50_000), np.sqrt(1 - 0.005**2)
    decay = np.exp(-0.005 * t)
    step = 1 - decay * (np.cos(w * t) + 0.005 / w * np.sin(w * t))
    acceleration = decay * (np.cos(w * t) - 0.005 / w * np.sin(w * t))
    np.testing.assert_allclose(y[:, 0], step, atol=1e-11)
    np.testing.assert_allclose(y[:, 1], acceleration, atol=1e-11)


@pytest.mark.parametrize("samples", [1, 2, 3, 5, 50])
def test_every_length_of_markov_parameters(samples):
    r = discretise(continuous_of(rig()), 1e-3)
    h = np.asarray(markov_parameters(r, samples=samples))
    truth = [np.asarray(r.D)]
    x = np.asarray(r.B)
    for _ in range(samples - 1):
        truth.append(np.asarray(r.C) @ x)
        x = np.asarray(r.A) @ x
    np.testing.assert_allclose(h, np.array(truth), atol=1e-12)


@pytest.mark.parametrize("model", [chain(), rig()], ids=["chain", "rig"])
def test_band_limited_input_inside_the_record(model):
    """A smooth pulse, zero at both ends, is its own band-limited interpolation: compare with finer grids."""
    m, dt, fine = continuous_of(model), 0.02, 50
    r = m.B.shape[1]

    def pulse(t):
        wave = np.exp(-((t - 4) ** 2) / 2) * np.sin(9 * t)
        return wave[:, None] * np.arange(1, r + 1)

    t = dt * np.arange(600)
    y = simulate_linear(m, pulse(t), dt, hold="band")
    tf = dt / fine * np.arange(600 * fine)
    truth = np.asarray(simulate_linear(m, pulse(tf), dt / fine, hold="first"))[::fine]
    finer = np.asarray(simulate_linear(m, pulse(dt / 100 * np.arange(60000)), dt / 100, hold="first"))[::100]
    # Richardson: the linear interpolation's error falls with the square of the step
    np.testing.assert_allclose(y, finer + (finer - truth) / 3, atol=3e-7 * np.abs(truth).max())


def test_band_limited_harmonic_with_initial_state_and_rigid_body():
    """cos(w t) on a free mass: x = x0 + v0 t + (1 - cos(w t)) / w^2; the ends are unknown."""
    model = lumped_model(
        "a", [1.0], inputs=[Input("f", "a", "band")], sensors=[Sensor("x", "a", "displacement")]
    )
    dt, w = 0.01, 2 * np.pi * 3
    t = dt * np.arange(2000)
    m = continuous_of(model)
    y = simulate_linear(m, np.cos(w * t), dt, hold="band", initial_state=np.array([0.5, -0.2]))[:, 0]
    truth = 0.5 - 0.2 * t + (1 - np.cos(w * t)) / w**2
    # an error e of the interpolated force near t = 0 stays as a velocity error of about e dt
    assert np.abs(y - truth).max() < 2e-3
    np.testing.assert_allclose(
        simulate(model, {"f": np.cos(w * t)}, dt=dt)[:, 0], y - 0.5 + 0.2 * t, atol=1e-9
    )


@pytest.mark.parametrize("hold", ["zero", "first", "band"])
def test_initial_state_is_found(hold):
    m = continuous_of(chain())
    u, x0 = noise(500, 3), noise(1, 6, 3)[0]
    y = np.array(simulate_linear(m, u, 0.05, hold=hold, initial_state=x0))
    y[:, 1] = np.nan
    fit = simulate(
        chain(hold=hold),
        Record(u, y, 0.05, inputs=["fa", "fb", "fc"], outputs=["sa", "sb", "sc"]),
        initial="estimate",
    )
    clean = np.asarray(simulate_linear(m, u, 0.05, hold=hold, initial_state=x0))
    np.testing.assert_allclose(fit, clean, atol=1e-9)


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_initial_state_of_a_realization(hold):
    r = discretise(continuous_of(chain()), 0.05, hold=hold)
    u, x0 = noise(500, 3), noise(1, 6, 3)[0]
    fit = estimate_initial_state(r, u, simulate_linear(r, u, initial_state=x0))
    np.testing.assert_allclose(fit.state, x0, atol=1e-10)
    assert fit.reason is None


def test_unobservable_initial_position_is_said_and_left_at_zero():
    r = discretise(continuous_of(rig()), 1e-3)
    u, x0 = noise(3000, 1), np.array([3.0, 3.1, 0.2, 0.3])
    y = simulate_linear(r, u, initial_state=x0)
    fit = estimate_initial_state(r, u, y)
    assert int(fit.unobservable) == 1
    assert "leave no trace" in fit.reason
    np.testing.assert_allclose(simulate_linear(r, u, initial_state=fit.state), y, atol=1e-8)
    np.testing.assert_allclose(fit.state[1] - fit.state[0], 0.1, atol=1e-9)


def test_inputs_go_by_name_in_any_order():
    u = noise(100, 4)
    y = simulate(chain(), Record(u, np.zeros((100, 1)), 0.01, inputs=["fc", "other", "fa", "fb"]))
    by_name = simulate(chain(), {"fa": u[:, 2], "fb": u[:, 3], "fc": u[:, 0]}, dt=0.01)
    np.testing.assert_array_equal(y, by_name)


def test_hold_of_the_record_or_of_the_model_counts():
    u = noise(100, 3)
    names = ["fa", "fb", "fc"]
    by_model = simulate(chain(hold="first"), Record(u, np.zeros(100), 0.01, inputs=names))
    by_record = simulate(chain(), Record(u, np.zeros(100), 0.01, inputs=names, hold="first"))
    np.testing.assert_array_equal(by_model, by_record)
    with pytest.raises(InputError, match="Make them agree"):
        simulate(chain(hold="band"), Record(u, np.zeros(100), 0.01, inputs=names, hold="first"))


def test_clear_errors():
    model, u = chain(), noise(10, 3)
    m = continuous_of(model)
    with pytest.raises(InputError, match="input 'fc' of the model is missing"):
        simulate(model, {"fa": u[:, 0], "fb": u[:, 1]}, dt=0.1)
    with pytest.raises(InputError, match="substeps must be at least 1"):
        simulate(model, {"fa": u[:, 0]}, dt=0.1, substeps=0)
    with pytest.raises(InputError, match="initial 'guess' is unknown"):
        simulate(model, {"fa": u[:, 0]}, dt=0.1, initial="guess")
    with pytest.raises(InputError, match="none of the model's sensors"):
        simulate(model, Record(u, u, 0.1, inputs=["fa", "fb", "fc"]), initial="estimate")
    with pytest.raises(InputError, match="needs the sampling interval"):
        simulate_linear(m, u)
    with pytest.raises(InputError, match="3 inputs, u has 2 columns"):
        simulate_linear(m, u[:, :2], 0.1)
    with pytest.raises(InputError, match="has its own dt"):
        simulate_linear(discretise(m, 0.1), u, 0.1)


def test_jit_vmap_and_derivatives():
    m, u = continuous_of(chain()), noise(130, 3)
    plain = simulate_linear(m, u, 0.01)
    np.testing.assert_allclose(jax.jit(lambda u: simulate_linear(m, u, 0.01))(u), plain, atol=1e-14)
    both = jax.vmap(lambda u: simulate_linear(m, u, 0.01))(jnp.stack([u, 2 * u]))
    np.testing.assert_allclose(both, np.stack([plain, 2 * plain]), atol=1e-13)

    def loss(k):
        model = lumped_model(
            "a",
            [1.0],
            k,
            [0.1],
            connections=[Connection("k", ("ground", "a"))],
            inputs=[Input("f", "a", "first")],
            sensors=[Sensor("x", "a", "acceleration")],
        )
        return (simulate(model, {"f": u[:, 0]}, dt=0.1) ** 2).sum()

    k, h = jnp.array([2.0]), 1e-5
    difference = (loss(k + h) - loss(k - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(loss)(k)[0], difference, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(loss, (k,), (jnp.ones(1),))[1], difference, rtol=1e-7)


def test_single_precision():
    m = jax.tree.map(lambda x: x.astype(jnp.float32), continuous_of(chain()))
    u = noise(300, 3).astype(np.float32)
    for hold in ("zero", "first", "band"):
        y = simulate_linear(m, u, 0.05, hold=hold)
        assert y.dtype == jnp.float32
        truth = simulate_linear(continuous_of(chain()), u.astype(float), 0.05, hold=hold)
        np.testing.assert_allclose(y, truth, atol=1e-4 * float(jnp.abs(truth).max()))
