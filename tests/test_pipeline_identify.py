"""The whole chain on band-limited records: accuracy, honest deviations, and every kind of record."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from band_limited import (
    DT,
    SEVEN,
    THREE,
    band_noise,
    chain,
    error,
    experiment,
    periodic,
    poles,
    respond,
)

from jaxsid import Direct, Fourier, InputError, InsufficientDataError, Record, Wavelet, identify
from jaxsid.mechanics.lumped import Connection, Input, Matrices, Sensor, lumped_model


class Limits(NamedTuple):
    """Largest relative errors of frequency, damping ratio, mass and stiffness, damping."""

    frequency: float
    ratio: float
    mass_stiffness: float
    damping: float


class Row(NamedTuple):
    """A system, its elements (mass, stiffness, damping), and what must be reached."""

    system: object
    elements: tuple
    noise: float
    colour: str | None
    limits: Limits


USUAL = Limits(0.001, 0.04, 0.02, 0.10)
DRIVE = ([0.0053, 0.18], [0, 600, 0], [0.05, 0.05, 0.1])
FREE_DRIVE = ([0.0053, 0.18], [0, 600], [0, 0.05])
OVER = ([1.2, 0.9], [3000, 2500], [1.5, 200.0])  # a real pole at 59 Hz, the edge of the excitation
FREE = ([1.2, 0.9, 0.7], [0, 2500, 2000], [0, 1.2, 1.0])
ROWS = {
    "one force": Row(chain(*THREE), THREE, 0.01, None, USUAL),
    "three forces": Row(chain(*THREE, driven=(0, 1, 2)), THREE, 0.01, None, USUAL),
    "drive": Row(chain(*DRIVE, kinds="vv"), DRIVE, 0.01, None, Limits(0.002, 0.04, 0.02, 0.15)),
    "free drive": Row(
        chain(*FREE_DRIVE, kinds="vv"), FREE_DRIVE, 0.01, None, Limits(0.002, 0.04, 0.02, 0.15)
    ),
    "seven": Row(chain(*SEVEN, kinds="d" * 7), SEVEN, 0.003, None, Limits(0.001, 0.04, 0.04, 0.15)),
    "mixed": Row(chain(*THREE, kinds="dva"), THREE, 0.01, None, USUAL),
    "overdamped": Row(chain(*OVER), OVER, 0.01, None, Limits(0.01, 0.04, 0.04, 0.10)),
    "much noise": Row(chain(*THREE), THREE, 0.10, None, Limits(0.005, 0.15, 0.10, 0.40)),
    "low noise": Row(chain(*THREE), THREE, 0.03, "low", Limits(0.002, 0.08, 0.05, 0.20)),
    "high noise": Row(chain(*THREE), THREE, 0.03, "high", Limits(0.002, 0.08, 0.05, 0.20)),
    "free": Row(chain(*FREE, kinds="vvv"), FREE, 0.01, None, Limits(0.001, 0.06, 0.04, 0.15)),
}


def nominal(system, elements=None, seed=0, hold="zero"):
    """The model with numbers wrong by +-30 %, as elements or, without these, as matrices."""
    rng = np.random.default_rng(100 + seed)
    wrong = lambda count=None: 1 + 0.3 * rng.choice([-1, 1], size=count)  # noqa: E731
    bodies = [f"b{i + 1}" for i in range(len(system.mass))]
    places = {
        "inputs": [Input(f"f{j + 1}", bodies[i], hold) for j, i in enumerate(system.driven)],
        "sensors": [Sensor(f"s{i + 1}", bodies[i], kind) for i, kind in enumerate(system.kind_names)],
    }
    if elements is None:
        matrices = Matrices(*(jnp.asarray(x * wrong()) for x in system[:3]))
        return lumped_model(bodies, matrices=matrices, **places)
    mass, stiffness, damping = (np.asarray(x, float) for x in elements)
    ends = ["ground", *bodies, "ground"]
    joints = [Connection(f"c{i + 1}", (ends[i], ends[i + 1])) for i in range(len(stiffness))]
    return lumped_model(
        bodies,
        mass * wrong(len(mass)),
        stiffness * wrong(len(stiffness)),
        damping * wrong(len(damping)),
        connections=joints,
        **places,
    )


def recorded(model, u, y, dt=DT, **options):
    names = {"inputs": [i.name for i in model.inputs], "outputs": [s.name for s in model.sensors]}
    return Record(u, y, dt, **{**names, **options})


def nearest_modes(found, system):
    """Relative errors of frequency and damping ratio, and both over their standard deviations, a true mode a row."""
    truth = poles(system)
    truth = truth[(truth.imag >= 0) & (np.abs(truth) > 1e-3)]
    own = np.asarray(found.modal.poles)
    rows = []
    for p in truth:
        i = np.argmin(np.abs(own - p))
        f, z = np.abs(own[i]) - np.abs(p), -own[i].real / np.abs(own[i]) + p.real / np.abs(p)
        oscillates = abs(p.imag) > 1e-6 * abs(p)
        pull = z / float(found.damping_ratio_std[i]) if oscillates else 0.0
        rows.append((abs(f / p), abs(z * abs(p) / p.real), f / float(found.frequency_std[i]), pull))
    return np.array(rows)


def check(found, system, limits):
    modes = nearest_modes(found, system)
    assert found.matrices is not None
    assert modes[:, 0].max() < limits.frequency
    assert modes[:, 1].max() < limits.ratio
    assert max(error(found.matrices.mass, system.mass)) < limits.mass_stiffness
    assert max(error(found.matrices.stiffness, system.stiffness)) < limits.mass_stiffness
    assert max(error(found.matrices.damping, system.damping)) < limits.damping


def unexpected(found):
    return [w for w in found.warnings if not w.startswith("The inputs excite")]


def run(row, seed, **options):
    model = nominal(row.system, row.elements if seed % 2 else None, seed)
    u, y = experiment(row.system, seed, row.noise, row.colour)
    return identify(model, recorded(model, u, y), **options)


# Every row in `test_accuracy_over_many_records`, which is slow: each new size of a system compiles for long.
@pytest.mark.parametrize(
    "name", ["one force", *(pytest.param(x, marks=pytest.mark.slow) for x in ("mixed", "free"))]
)
def test_accuracy_from_one_noisy_record(name):
    row = ROWS[name]
    found = run(row, 1)
    check(found, row.system, row.limits)
    assert unexpected(found) == []
    assert found.order == len(found.modal.poles)
    # nothing but noise is left over, and the prediction says so
    np.testing.assert_allclose(found.train_nrmse, found.noise_floor, rtol=0.1)
    np.testing.assert_allclose(found.noise_floor, row.noise / np.sqrt(1 + row.noise**2), rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_accuracy_over_many_records(name):
    row = ROWS[name]
    for seed in range(1, 8):
        found = run(row, seed)
        check(found, row.system, row.limits)
        assert unexpected(found) == []


@pytest.mark.slow
def test_deviations_are_those_of_the_errors():
    row = ROWS["one force"]
    pulls, modes = [], []
    for seed in range(40):
        found = run(row, seed, structure="free")
        upper = np.triu_indices(3)
        for name in ("mass", "damping", "stiffness"):
            wrong = np.asarray(getattr(found.matrices, name)) - getattr(row.system, name)
            pulls.append((wrong / np.asarray(getattr(found.matrices_std, name)))[upper])
        modes.append(nearest_modes(found, row.system)[:, 2:])
    for sample in (*(np.array(pulls[i::3]) for i in range(3)), *np.moveaxis(np.array(modes), 2, 0)):
        assert 0.8 < np.sqrt((sample**2).mean()) < 1.25


SYSTEM = ROWS["one force"].system


@pytest.fixture(scope="module")
def model():
    return nominal(SYSTEM)


@pytest.fixture(scope="module")
def noisy(model):
    return recorded(model, *experiment(SYSTEM, 3))


def test_noise_free_records_give_nearly_exact_matrices(model):
    found = identify(model, recorded(model, *experiment(SYSTEM, 3, noise=0.0)))
    check(found, SYSTEM, Limits(1e-8, 1e-7, 1e-7, 1e-6))
    assert max(found.train_nrmse) < 1e-5


@pytest.mark.slow
def test_records_of_different_lengths_and_states_are_used_together(model):
    rng = np.random.default_rng(4)
    records = []
    for seconds in (9.0, 14.0):
        u = band_noise(rng, int(seconds / DT), 1)
        y = respond(SYSTEM, u, state=rng.standard_normal(6) * np.repeat([0.002, 0.2], 3))
        records.append(recorded(model, u, y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)))
    found = identify(model, records)
    check(found, SYSTEM, USUAL)
    assert unexpected(found) == []
    assert [len(y) for y in found.predictions] == [9000, 14000]
    assert max(found.train_nrmse) < 0.011


def test_a_start_in_motion_does_not_disturb(model):
    rng = np.random.default_rng(5)
    u = band_noise(rng, 20000, 1)
    y = respond(SYSTEM, u, state=np.array([0.01, -0.02, 0.01, 1.0, 0.5, -1.0]))
    record = recorded(model, u, y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape))
    found = identify(model, record)
    check(found, SYSTEM, USUAL)
    assert max(found.train_nrmse) < 0.011
    assert min(identify(model, record, initial="rest").train_nrmse) > 0.05


@pytest.mark.slow
def test_two_sampling_rates_of_one_system(model):
    records = [recorded(model, *experiment(SYSTEM, 6, dt=dt), dt) for dt in (1e-3, 2e-3)]
    found = identify(model, records)
    check(found, SYSTEM, USUAL)
    assert unexpected(found) == []


@pytest.mark.slow
def test_two_sampling_rates_without_noise_are_exactly_one_system(model):
    records = [recorded(model, *experiment(SYSTEM, 6, noise=0.0, dt=dt), dt) for dt in (1e-3, 2e-3)]
    check(identify(model, records), SYSTEM, Limits(1e-8, 1e-7, 1e-7, 1e-6))


@pytest.mark.slow
def test_a_roving_sensor(model):
    records = []
    for i in range(3):
        u, y = experiment(SYSTEM, 10 + i)
        records.append(recorded(model, u, y[:, [i]], outputs=[f"s{i + 1}"]))
    found = identify(model, records)
    assert found.outputs == ("s1", "s2", "s3")
    check(found, SYSTEM, USUAL)


@pytest.mark.slow
def test_linear_hold():
    model = nominal(SYSTEM, hold="first")
    rng = np.random.default_rng(7)
    u = band_noise(rng, 20000, 1)
    y = respond(SYSTEM, u, hold="foh")
    found = identify(model, recorded(model, u, y, hold="first"))
    check(found, SYSTEM, Limits(1e-6, 1e-5, 1e-5, 1e-4))


@pytest.mark.slow
def test_band_limited_hold():
    model = nominal(SYSTEM, hold="band")
    u, y = periodic(SYSTEM, np.random.default_rng(8), 20000, 32768)
    noise = 0.01 * y.std(axis=0) * np.random.default_rng(9).standard_normal(y.shape)
    found = identify(model, recorded(model, u, y + noise, hold="band"))
    check(found, SYSTEM, USUAL)


@pytest.mark.slow
def test_inputs_of_different_holds():
    system = chain(*THREE, driven=(0, 2))
    model = nominal(system)
    rng = np.random.default_rng(12)
    u = band_noise(rng, 20000, 2)
    y = respond(system, u * [1, 0]) + respond(system, u * [0, 1], hold="foh")
    found = identify(model, recorded(model, u, y, hold=("zero", "first")))
    check(found, system, Limits(1e-6, 1e-5, 1e-5, 1e-4))


@pytest.mark.slow
def test_fewer_sensors_than_bodies_still_give_modes(model, noisy):
    seen = recorded(model, noisy.u, noisy.y[:, :2], outputs=["s1", "s2"])
    found = identify(model, seen, structure="free")
    assert found.matrices is None
    assert found.identified is None
    assert found.matrices_std is None
    modes = nearest_modes(found, SYSTEM)
    assert modes[:, 0].max() < USUAL.frequency
    assert modes[:, 1].max() < USUAL.ratio
    assert any("No sensor on b3" in w for w in found.warnings)
    assert any("No record holds s3" in w for w in found.warnings)


@pytest.mark.slow
def test_an_order_that_is_not_the_models_gives_modes_without_matrices(model, noisy):
    found = identify(model, noisy, order=8)
    assert (found.order, found.matrices) == (8, None)
    assert "Order 8 was asked for" in found.order_reason
    assert any("6 visible states" in w for w in found.warnings)
    assert nearest_modes(found, SYSTEM)[:, 0].max() < USUAL.frequency


@pytest.mark.slow
def test_data_correlations(model, noisy):
    found = identify(model, noisy, realization="era_dc")
    check(found, SYSTEM, USUAL)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [Wavelet(), Direct(), Fourier()],
    ids=["wavelet", "direct", "fourier"],
)
def test_other_estimators_on_a_full_band_record(model, method):
    rng = np.random.default_rng(13)
    u = rng.standard_normal((8000, 1))
    y = respond(SYSTEM, u)
    record = recorded(model, u, y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape))
    found = identify(model, record, method=method)
    check(found, SYSTEM, Limits(0.002, 0.08, 0.04, 0.2))
    assert "in-band" not in found.response.method


def test_the_identified_model_repeats_the_record(model, noisy):
    from jaxsid import simulate

    found = identify(model, noisy)
    assert found.identified is not None
    left = np.asarray(noisy.y - simulate(found.identified, noisy))
    assert (left.std(axis=0) / np.asarray(noisy.y).std(axis=0)).max() < 0.0105


def test_progress_is_told_in_order(model, noisy):
    said = []
    identify(model, noisy, progress=said.append)
    assert said[0].startswith("impulse response")
    assert len(said) == 3


def test_what_cannot_be_used_is_told(model, noisy):
    u, y = np.asarray(noisy.u), np.asarray(noisy.y)
    for options, text in (
        ({"initial": "zero"}, "choose estimate or rest"),
        ({"realization": "svd"}, "choose era"),
        ({"structure": "some"}, "choose auto or free or model"),
    ):
        with pytest.raises(InputError, match=text):
            identify(model, noisy, **options)
    with pytest.raises(InputError, match="no record was given"):
        identify(model, [])
    with pytest.raises(InputError, match="'s9' is no sensor of the model"):
        identify(model, recorded(model, u, y, outputs=["s1", "s2", "s9"]))
    with pytest.raises(InputError, match=r"inputs .* are not those of the model"):
        identify(model, recorded(model, u, y, inputs=["g"]))
    with pytest.raises(InputError, match="zero throughout"):
        identify(model, recorded(model, 0 * u, y))
    with pytest.raises(InsufficientDataError, match="record at least 60"):
        identify(model, recorded(model, u[:50], y[:50]))
    with pytest.raises(InsufficientDataError, match="spectral lines"):
        identify(model, noisy, band=(10.0, 10.2))
    tone = np.sin(2 * np.pi * 10 * np.arange(20000) * DT)[:, None]
    with pytest.raises(InsufficientDataError, match=r"band|frequenc"):
        identify(model, recorded(model, tone, respond(SYSTEM, tone)))


def unstable_record(seed=0):
    """A mass on a negative spring, held upright by feedback: force and noisy displacement, by scipy alone."""
    rng = np.random.default_rng(seed)
    A = np.array([[0.0, 1.0], [40.0, -0.5]])
    step = scipy.linalg.expm(DT * np.block([[A, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]))
    command, x = 20 * band_noise(rng, 12000, 1)[:, 0], np.zeros(2)
    u, y = np.zeros((2, len(command)))
    for k, r in enumerate(command):
        y[k], u[k] = x[0], r - 100 * x[0] - 10 * x[1]
        x = step[:2, :2] @ x + step[:2, 2] * u[k]
    return u, y + 0.01 * y.std() * rng.standard_normal(len(y)), np.linalg.eigvals(A)


@pytest.mark.slow
def test_an_unstable_system_keeps_its_pole_and_is_said_to_be_unstable():
    u, y, truth = unstable_record()
    model = lumped_model(
        ["b1"],
        [1.3],
        [50.0],
        [0.3],
        connections=[Connection("c1", ("ground", "b1"))],
        inputs=[Input("f1", "b1")],
        sensors=[Sensor("s1", "b1", "displacement")],
    )
    found = identify(model, recorded(model, u, y))
    growing = truth[truth > 0][0]
    assert np.abs(np.asarray(found.modal.poles) - growing).min() < 0.01 * growing
    assert found.matrices is None
    assert any("unstable" in w for w in found.warnings)
    assert np.isnan(np.asarray(found.train_nrmse)).all()


@pytest.mark.slow
def test_a_hold_that_is_not_the_forces_is_noticed():
    """Forces that go on between the samples: as if held they spoil the fit, which says so; "band" is exact."""
    rng = np.random.default_rng(0)
    system, often = chain(*THREE), 20
    u = band_noise(rng, 12000 * often, 1, DT / often)
    y = respond(system, u, DT / often)[::often]
    y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    held, smooth = (
        identify(m, recorded(m, u[::often], y, hold=hold))
        for hold in ("zero", "band")
        for m in (nominal(system, THREE, hold=hold),)
    )
    assert any("'band'" in w for w in held.warnings)
    assert not any("'band'" in w for w in smooth.warnings)
    check(smooth, system, USUAL)
