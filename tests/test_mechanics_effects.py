"""Simulation with effects against scipy's adaptive integration from event to event, and against invariances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_truth import GROUND, Chain, Truth
from scipy.integrate import solve_ivp

import jaxsid
from jaxsid.checks import InputError
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor, lumped_model, second_order

DT, SAMPLES = 1e-3, 800
BODIES = ("b1", "b2", "b3")
SENSED = ((0, "acceleration"), (1, "displacement"), (2, "velocity"))
MASS, STIFFNESS, DAMPING = [1.0, 1.2, 0.8], [2000.0, 1500.0, 1000.0], [8.0, 6.0, 5.0]
# effects of 5 to 60 % of the response: kind, place, parameters, worst relative rms error
JOINT, WALL = (0, 1), (GROUND, 0)
GIVING = {"force": 2.0, "static_force": 3.0, "velocity": 0.1, "stiffness": 3000.0}
CASES = [
    ("mass_error", 1, {"factor": 1.3}, 1e-9),
    ("stiffness_error", JOINT, {"factor": 0.7}, 1e-9),
    ("stiffness_error", WALL, {"factor": 0.7}, 1e-9),
    ("damping_error", JOINT, {"factor": 3.0}, 1e-9),
    ("missing_connection", (0, 2), {"stiffness": 300.0, "damping": 2.0}, 1e-9),
    ("missing_mode", 1, {"mass": 0.2, "stiffness": 300.0, "damping": 0.5}, 1e-9),
    ("coulomb_friction", WALL, {"force": 3.0}, 1e-3),
    ("coulomb_friction", JOINT, {"force": 2.0}, 1e-3),
    ("coulomb_friction", JOINT, {"force": 12.0}, 1e-3),
    ("stribeck_friction", WALL, {"force": 2.0, "static_force": 3.0, "velocity": 0.1}, 1e-3),
    ("stribeck_friction", JOINT, GIVING, 1e-4),
    ("quadratic_damping", JOINT, {"coefficient": 15.0}, 1e-4),
    ("cubic_stiffness", JOINT, {"coefficient": 3e6}, 1e-4),
    ("quadratic_stiffness", JOINT, {"coefficient": 3e4}, 1e-4),
    ("bilinear_stiffness", JOINT, {"stiffness": 600.0}, 1e-4),
    ("backlash", JOINT, {"half_gap": 0.002}, 1e-3),
    ("end_stop", JOINT, {"stiffness": 4000.0, "clearance": 0.01}, 1e-3),
    ("hysteresis", JOINT, {"stiffness": 800.0, "beta": 60.0, "gamma": 40.0, "exponent": 1.0}, 1e-4),
    ("hysteresis", JOINT, {"stiffness": 800.0, "beta": 2e3, "gamma": -1e3, "exponent": 1.7}, 1e-4),
    ("cogging_ripple", JOINT, {"amplitude": 3.0, "wavenumber": 300.0, "phase": 0.4}, 1e-4),
    ("constant_load", 2, {"force": 4.0}, 1e-4),
    ("periodic_disturbance", 2, {"amplitude": 4.0, "frequency_hz": 7.3, "phase": 0.3}, 1e-4),
    ("time_varying_stiffness", JOINT, {"rate": 800.0}, 1e-4),
    ("sensor_gain", 1, {"factor": 1.2}, 1e-9),
    ("sensor_bias", 0, {"offset": 2.0}, 1e-9),
    ("sensor_delay", 0, {"delay": 0.0034}, 1e-6),
    ("sensor_delay", 2, {"delay": 0.002}, 1e-6),
    ("sensor_lag", 0, {"time_constant": 0.004}, 1e-9),
    ("sensor_lag", 1, {"time_constant": 0.004}, 1e-9),
    ("input_gain", 0, {"factor": 0.8}, 1e-9),
    ("input_delay", 0, {"delay": 0.0034}, 1e-4),
    ("input_delay", 0, {"delay": 0.003}, 1e-6),
    ("actuator_lag", 0, {"time_constant": 0.004}, 1e-9),
    ("actuator_saturation", 0, {"limit": 15.0}, 1e-9),
]


def chain(effects=(), hold="zero", kinds=SENSED):
    ends = ("ground", *BODIES)
    return lumped_model(
        BODIES,
        MASS,
        STIFFNESS,
        DAMPING,
        connections=[Connection(f"c{i + 1}", ends[i : i + 2]) for i in range(3)],
        inputs=[Input("drive", "b1", hold)],
        sensors=[Sensor(f"s{i}", BODIES[body], kind) for i, (body, kind) in enumerate(kinds)],
        effects=effects,
    )


def effect(kind, place, parameters):
    where = CATALOGUE[kind].where
    name = lambda i: "ground" if i == GROUND else BODIES[i]  # noqa: E731
    named = {
        "between": lambda: tuple(name(i) for i in place),
        "body": lambda: name(place),
        "sensor": lambda: f"s{place}",
        "input": lambda: "drive",
    }[where]()
    return Effect(kind, ((where, named),), {k: jnp.asarray(float(v)) for k, v in parameters.items()})


def drive(samples=SAMPLES, seed=0):
    f = np.fft.rfftfreq(samples, DT)
    phase = np.exp(2j * np.pi * np.random.default_rng(seed).random(len(f)))
    u = np.fft.irfft(np.where((f > 0.5) & (f < 20), phase, 0), samples)
    return 15 * u / u.std()


def record(u, hold="zero"):
    names = tuple(f"s{i}" for i in range(len(SENSED)))
    return jaxsid.Record(u[:, None], np.zeros((len(u), 3)), DT, inputs=("drive",), outputs=names, hold=hold)


def error(y, truth):
    return (np.sqrt(((np.asarray(y) - truth) ** 2).mean(axis=0)) / np.sqrt((truth**2).mean(axis=0))).max()


def truth_of(kind, place, parameters, u, hold="zero"):
    plain = second_order(chain())
    of = Chain(*(np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness)), 0, SENSED)
    return Truth(of, kind, place, parameters, DT, hold).run(u)


@pytest.mark.parametrize(("kind", "place", "parameters", "limit"), CASES)
def test_motion_is_that_of_the_reference(kind, place, parameters, limit):
    u = drive()
    y = jaxsid.simulate(chain([effect(kind, place, parameters)]), record(u))
    truth = truth_of(kind, place, parameters, u)
    assert error(y, truth) < limit
    plain = np.asarray(jaxsid.simulate(chain(), record(u)))
    assert error(plain, truth) > 0.02  # the effect is there to be seen


def test_friction_that_hardly_gives_is_friction_that_sticks():
    """As the stiffness grows; steps of the first tries are too long for it."""
    u, rigid = drive(), {k: v for k, v in GIVING.items() if k != "stiffness"}
    sticking = np.asarray(jaxsid.simulate(chain([effect("stribeck_friction", JOINT, rigid)]), record(u)))
    far = [
        error(
            jaxsid.simulate(chain([effect("stribeck_friction", JOINT, rigid | {"stiffness": k})]), record(u)),
            sticking,
        )
        for k in (3e3, 1e4, 3e4)
    ]
    assert far[1] < 0.8 * far[0]
    assert far[2] < 0.8 * far[1] < 0.1


def test_every_kind_is_checked():
    assert {case[0] for case in CASES} == set(CATALOGUE)


@pytest.mark.parametrize(
    ("kind", "place", "parameters", "limit"),
    [
        ("cubic_stiffness", JOINT, {"coefficient": 3e6}, 1e-4),
        ("coulomb_friction", JOINT, {"force": 2.0}, 1e-3),
        ("input_delay", 0, {"delay": 0.0034}, 1e-4),
        ("sensor_delay", 0, {"delay": 0.0034}, 1e-6),
    ],
)
def test_first_order_hold(kind, place, parameters, limit):
    u = drive(400)
    y = jaxsid.simulate(chain([effect(kind, place, parameters)], "first"), record(u))
    assert error(y, truth_of(kind, place, parameters, u, "first")) < limit


def test_band_limited_input_as_of_the_linear_model():
    u = drive()
    gain = effect("sensor_gain", 1, {"factor": 1.0})
    linear = np.asarray(jaxsid.simulate(chain(hold="band"), record(u, "band")))
    assert error(jaxsid.simulate(chain([gain], "band"), record(u, "band")), linear) < 1e-4


def test_effects_of_no_size_change_nothing():
    u = drive(500)
    linear = np.asarray(jaxsid.simulate(chain(), record(u)))
    none = [
        effect("coulomb_friction", JOINT, {"force": 0.0}),
        effect("backlash", (1, 2), {"half_gap": 0.0}),
        effect("sensor_delay", 0, {"delay": 0.0}),
        effect("actuator_lag", 0, {"time_constant": 0.0}),
        effect("missing_mode", 1, {"mass": 0.0, "stiffness": 0.0}),
    ]
    assert error(jaxsid.simulate(chain(none), record(u)), linear) < 1e-9


@pytest.mark.slow
def test_several_effects_in_any_order_and_direction():
    u = drive(500)
    one = effect("coulomb_friction", JOINT, {"force": 2.0})
    turned = effect("coulomb_friction", (1, 0), {"force": 2.0})
    two = effect("cubic_stiffness", (1, 2), {"coefficient": 3e6})
    first = np.asarray(jaxsid.simulate(chain([one, two]), record(u)))
    assert error(jaxsid.simulate(chain([two, turned]), record(u)), first) < 1e-3
    # two contacts side by side are one of the sum
    halves = [effect("coulomb_friction", JOINT, {"force": 1.0})] * 2
    alone = np.asarray(jaxsid.simulate(chain([one]), record(u)))
    assert error(jaxsid.simulate(chain(halves), record(u)), alone) < 1e-3


@pytest.mark.slow
def test_contacts_that_act_on_each_other():
    """Friction on both sides of a body: each rests or slides as if the other were known."""
    u = drive(600)
    both = [
        effect("coulomb_friction", WALL, {"force": 2.0}),
        effect("coulomb_friction", JOINT, {"force": 2.0}),
    ]
    coarse, fine = (np.asarray(jaxsid.simulate(chain(both), record(u), substeps=n)) for n in (4, 32))
    assert error(coarse, fine) < 1e-3
    # what rests keeps its place: friction above all forces holds the first body
    held = [effect("coulomb_friction", WALL, {"force": 1e3}), both[1]]
    y = np.asarray(jaxsid.simulate(chain(held, kinds=((0, "acceleration"),) * 3), record(u)))
    assert np.abs(y).max() < 1e-9


def test_friction_takes_energy_from_a_free_motion():
    """A block on a spring: its swings shrink by 4 F / k each, and it stops where the spring cannot move it."""
    friction = Effect("coulomb_friction", (("between", ("ground", "b")),), {"force": jnp.asarray(1.0)})
    block = lumped_model(
        ["b"],
        [1.0],
        [100.0],
        [0.0],
        connections=[Connection("k", ("ground", "b"))],
        inputs=[Input("f", "b")],
        sensors=[Sensor("d", "b", "displacement")],
        effects=[friction],
    )
    u = np.zeros(4000)
    u[:2000] = 10.0  # a step, then let go: 0.1 m less 0.01 from where friction lets it rest
    given = jaxsid.Record(u, np.zeros((4000, 1)), DT, inputs=("f",), outputs=("d",))
    y = np.asarray(jaxsid.simulate(block, given))[:, 0]
    peaks = [y[(2000 if late else 0) + np.arange(2000)] for late in (False, True)]
    turning = np.flatnonzero(np.diff(np.sign(np.diff(peaks[0]))) != 0)[:4] + 1
    # about 0.1: 0, 0.18, 0.04, 0.14, ... each swing 0.02 less on either side
    np.testing.assert_allclose(peaks[0][turning], [0.18, 0.04, 0.14, 0.08], atol=2e-4)
    assert np.ptp(y[1900:2000]) < 1e-9
    assert np.ptp(y[3900:]) < 1e-9


def values_of(model, u, **parameters):
    """Outputs as a function of an effect's parameters and the first mass, to be differentiated."""
    kind = model.effects[0]
    names = list(kind.parameters)

    def outputs(theta):
        of = dict(zip(names, theta[1:], strict=True))
        moved = lumped_model(
            model.bodies,
            model.mass.at[0].set(theta[0]),
            model.stiffness,
            model.damping,
            connections=model.connections,
            inputs=model.inputs,
            sensors=model.sensors,
            effects=[Effect(kind.kind, kind.place, of)],
        )
        return jaxsid.simulate(moved, record(u), substeps=2)

    return outputs, jnp.array([1.0, *(float(x) for x in kind.parameters.values())])


@pytest.mark.parametrize(
    ("kind", "place", "parameters"),
    [
        pytest.param("coulomb_friction", WALL, {"force": 3.0}, marks=pytest.mark.slow),
        pytest.param(
            "hysteresis",
            JOINT,
            {"stiffness": 800.0, "beta": 60.0, "gamma": 40.0, "exponent": 1.3},
            marks=pytest.mark.slow,
        ),
        pytest.param("backlash", JOINT, {"half_gap": 0.002}, marks=pytest.mark.slow),
        pytest.param("input_delay", 0, {"delay": 0.0034}, marks=pytest.mark.slow),
        pytest.param("sensor_lag", 0, {"time_constant": 0.004}, marks=pytest.mark.slow),
        pytest.param(
            "missing_mode", 1, {"mass": 0.2, "stiffness": 300.0, "damping": 0.5}, marks=pytest.mark.slow
        ),
    ],
)
def test_derivatives(kind, place, parameters):
    u = drive(300)
    outputs, theta = values_of(chain([effect(kind, place, parameters)]), u)
    forward = np.asarray(jax.jacfwd(outputs)(theta))
    assert np.isfinite(forward).all()
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(300, 3)))
    reverse = np.asarray(jax.grad(lambda t: (weights * outputs(t)).sum())(theta))
    np.testing.assert_allclose(reverse, np.einsum("ij,ijp->p", weights, forward), rtol=1e-6)
    for i, value in enumerate(np.asarray(theta)):
        step = 1e-6 * value * np.eye(len(theta))[i]
        numeric = (np.asarray(outputs(theta + step)) - np.asarray(outputs(theta - step))) / (2e-6 * value)
        assert np.linalg.norm(numeric - forward[..., i]) < 1e-4 * np.linalg.norm(numeric)


def test_one_program_for_all_kinds_over_a_batch():
    """Candidates of different kinds and places side by side, as one array program."""
    from jaxsid.mechanics.nonlinear import respond, state_count
    from jaxsid.mechanics.slots import slots_of

    u = drive(300)
    chosen = [CASES[i] for i in (0, 4, 6, 11, 16, 24, 31)]
    models = [chain([effect(*case[:3])]) for case in chosen]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(slots_of(m) for m in models))
    state, plain = jnp.zeros(state_count(3, 1)), second_order(chain())
    given = (plain, jnp.asarray(u)[:, None], jnp.array([False]), jnp.asarray(DT))
    traces = []

    @jax.jit
    def run(slots):
        traces.append(1)
        return respond(given[0], slots, *given[1:], state, 2).outputs

    batch = np.asarray(jax.vmap(run)(stacked))
    for model, y in zip(models, batch, strict=True):
        np.testing.assert_allclose(y, jaxsid.simulate(model, record(u), substeps=2), rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(run(slots_of(model)), y, rtol=1e-8, atol=1e-10)
    assert len(traces) == 1


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 6, 11, 24, 31])
def test_one_and_two_steps_side_by_side_are_those_one_after_the_other(number):
    from jaxsid.mechanics.nonlinear import respond, respond_twice, state_count
    from jaxsid.mechanics.slots import slots_of

    kind, place, parameters = CASES[number][:3]
    slots, u = slots_of(chain([effect(kind, place, parameters)])), jnp.asarray(drive(300))[:, None]
    given = (second_order(chain()), slots, u, jnp.array([False]), jnp.asarray(DT))
    moving = jnp.asarray(np.random.default_rng(3).normal(size=state_count(3, 1))) * 1e-3
    step_by_step = jax.jit(respond, static_argnums=6)
    for substeps, found in enumerate(jax.jit(respond_twice)(*given, moving), start=1):
        for x, y in zip(found, step_by_step(*given, moving, substeps), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9 * np.abs(np.asarray(y)).max())


def test_single_precision():
    u = drive(400)
    model = chain([effect("coulomb_friction", JOINT, {"force": 2.0})])
    double = np.asarray(jaxsid.simulate(model, record(u), substeps=4))
    low = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (model, record(u)))
    single = jaxsid.simulate(*low, substeps=4)
    assert single.dtype == jnp.float32
    assert error(single, double) < 1e-3


@pytest.mark.slow
def test_initial_state_with_hidden_states_is_found():
    u = drive(1600)
    kinds = ((0, "acceleration"), (1, "displacement"), (2, "velocity"))
    model = chain([effect("coulomb_friction", JOINT, {"force": 2.0})], kinds=kinds)
    y = np.asarray(jaxsid.simulate(model, record(u)))[800:]
    late = jaxsid.Record(u[800:, None], y, DT, inputs=("drive",), outputs=("s0", "s1", "s2"))
    assert error(jaxsid.simulate(model, late, initial="estimate"), y) < 1e-3


def test_parameters_one_for_each_record():
    u = drive(300)
    phases = {"amplitude": 4.0, "frequency_hz": 7.0}
    body = (("body", "b3"),)
    both = Effect("periodic_disturbance", body, {**phases, "phase": jnp.array([0.3, 1.2])})
    for number, phase in enumerate((0.3, 1.2)):
        one = Effect("periodic_disturbance", body, {**phases, "phase": jnp.asarray(phase)})
        y = jaxsid.simulate(chain([both]), record(u), number=number)
        np.testing.assert_allclose(y, jaxsid.simulate(chain([one]), record(u)), atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "place", "parameters", "words"),
    [
        (
            "coulomb_fricton",
            (("between", ("ground", "b1")),),
            {"force": 1.0},
            "did you mean 'coulomb_friction'",
        ),
        ("coulomb_friction", (("body", "b1"),), {"force": 1.0}, "its place is 'between', not 'body'"),
        ("coulomb_friction", (("between", ("ground", "b1")),), {}, "'force' is missing"),
        ("coulomb_friction", (("between", ("ground", "b1")),), {"force": -1.0}, "at least 0"),
        ("coulomb_friction", (("between", ("b1", "b1")),), {"force": 1.0}, "to itself"),
        ("sensor_delay", (("sensor", "s0"),), {"lag": 1.0}, "no parameter 'lag'"),
        ("sensor_delay", (("sensor", "gyro"),), {"delay": 1.0}, "sensor 'gyro' is unknown"),
        ("stiffness_error", (("between", ("b1", "b2")),), {}, "give one of factor, value"),
    ],
)
def test_bad_effects(kind, place, parameters, words):
    with pytest.raises(InputError, match=words):
        chain([Effect(kind, place, {k: jnp.asarray(v) for k, v in parameters.items()})])


def test_a_motion_without_bounds_is_said():
    growing = effect("cubic_stiffness", WALL, {"coefficient": -1e9})
    with pytest.raises(InputError, match="grows beyond all bounds"):
        jaxsid.simulate(chain([growing]), record(drive(600)))


def test_a_chaotic_motion_warns():
    wild = effect("end_stop", JOINT, {"stiffness": 2e6, "clearance": 1e-3})
    with pytest.warns(UserWarning, match="when steps are halved"):
        jaxsid.simulate(chain([wild]), record(drive()))


@pytest.mark.parametrize(
    ("beta", "gamma", "exponent", "saturates"),
    [(60.0, 40.0, 1.0, True), (2e3, -1e3, 1.7, True), (10.0, 300.0, 1.2, True), (0.02, -35.0, 1.0, False)],
)
def test_a_loop_makes_sense_where_its_memory_saturates(beta, gamma, exponent, saturates):
    """Along one stroke, scipy: either to (beta + gamma)^(-1/n), or without bound."""
    kind = CATALOGUE["hysteresis"]
    last = 3.0  # many times what saturates it
    grown = lambda x, z: z[0] - 1e3  # noqa: E731
    grown.terminal = True
    rate = lambda x, z: [1 - (beta * np.sign(z[0]) + gamma) * abs(z[0]) ** exponent]  # noqa: E731
    path = solve_ivp(rate, (0, last), [0.0], events=grown, rtol=1e-9, atol=1e-12)
    if saturates:
        np.testing.assert_allclose(path.y[0, -1], (beta + gamma) ** (-1 / exponent), rtol=1e-6)
    else:
        assert path.y[0, -1] > 100
    assert kind.sensible(1.0, beta, gamma, exponent) == saturates
    assert not kind.sensible(-1.0, beta, gamma, exponent)


@pytest.mark.parametrize(
    ("damping", "swings"), [(0.0, True), (0.9, True), (1.9, True), (2.1, False), (9.0, False)]
)
def test_a_part_makes_sense_as_a_mode_where_it_swings(damping, swings):
    """By its poles: m s^2 + c s + k with m = 0.5, k = 2."""
    poles = np.roots([0.5, damping, 2.0])
    assert (np.abs(poles.imag) > 0).all() == swings
    assert CATALOGUE["missing_mode"].sensible(0.5, 2.0, damping) == swings
    assert not CATALOGUE["missing_mode"].sensible(0.5, 0.0, damping)
