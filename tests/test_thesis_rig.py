"""Section 6.3 of the thesis on the twin of its rig: inertias, stiffness, damping, and a mode that is none."""

import numpy as np
import pytest
from reference_markov import pole_error

import jaxsid
from jaxsid.examples import exact_record, rig, rig_model_nominal, rig_record, stepped_sine
from jaxsid.records import ImpulseResponse, Record

DT = 1e-3
INERTIA = (0.0053, 0.18)
STIFFNESS, DAMPING = 9365.0, 0.8268
BEARINGS = (0.4352, 0.4782)


def visible_poles():
    """Poles of motor velocity, load velocity and twist: all but the free rotation."""
    (jm, jl), (dm, dl), k, c = INERTIA, BEARINGS, STIFFNESS, DAMPING
    motor = [-(c + dm) / jm, c / jm, k / jm]
    load = [c / jl, -(c + dl) / jl, -k / jl]
    poles = np.linalg.eigvals(np.array([motor, load, [-1, 1, 0]]))
    return poles[np.argsort(np.abs(poles))]


POLES = visible_poles()


def errors(model):
    """Relative errors of motor and load inertia, gearbox stiffness, and its damping from either row."""
    M, D, K = (np.asarray(x) for x in (model.mass, model.damping, model.stiffness))
    return np.array(
        [
            M[0, 0] / INERTIA[0] - 1,
            M[1, 1] / INERTIA[1] - 1,
            -K[0, 1] / STIFFNESS - 1,
            -D[0, 1] / DAMPING - 1,
            -D[1, 0] / DAMPING - 1,
        ]
    )


def assert_identified(found):
    """Targets: 1 % for inertias and stiffness, 5 % for damping; reached are parts in ten thousand.

    The bounds are four standard deviations of one record (Cramer-Rao) or more: 0.12 % for the slow pole.
    """
    poles = np.asarray(found.modal.poles)
    assert pole_error(poles, POLES[:1]) < 5e-3
    assert pole_error(poles, POLES[1:]) < 1e-4
    inertia_m, inertia_l, stiffness, *damping = np.abs(errors(found.matrices))
    assert max(inertia_m, inertia_l, stiffness) < 1e-3
    assert max(damping) < 5e-3
    bearings = np.asarray(found.matrices.damping).sum(axis=1)
    np.testing.assert_allclose(bearings, BEARINGS, rtol=0.02)


@pytest.fixture(scope="module")
def found():
    """From the nominal model of the builder, whose numbers are 15 to 40 % wrong."""
    return jaxsid.identify(rig_model_nominal(), rig_record(0))


@pytest.mark.slow
def test_noisy_record_of_the_twin(found):
    assert found.order == 3
    assert_identified(found)


@pytest.mark.slow
def test_cbsi_alone_gives_inertia_and_stiffness_but_not_the_split_of_damping(found):
    """Three states of two bodies: D[motor, load] hangs on the twist of the gearbox in the slow mode, which is
    a two-thousandth of the velocities; D[load, motor] does not."""
    inertia_m, inertia_l, stiffness, _, from_load = np.abs(errors(found.cbsi))
    assert max(inertia_m, inertia_l, stiffness) < 1e-3
    assert from_load < 0.02
    total = np.asarray(found.cbsi.damping).sum()
    assert total == pytest.approx(sum(BEARINGS), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_other_draws_of_the_noise(seed):
    assert_identified(jaxsid.identify(rig_model_nominal(), rig_record(seed)))


def pulse_response():
    return np.asarray(exact_record(rig(), np.eye(1, 2001)[0], DT).y)[:, :, None]


def test_velocities_of_a_free_pair_show_three_states():
    """Order 4 on the exact response is order 3 and rounding; CBSI must be told what is free."""
    ir = ImpulseResponse(pulse_response(), DT)
    three, four = (jaxsid.era(ir, order=n, rows=500, cols=500) for n in (3, 4))
    assert three.singular_values is not None
    assert three.singular_values[3] < 1e-13 * three.singular_values[2]
    assert pole_error(jaxsid.modal(three).poles, POLES) < 1e-10
    with pytest.raises(jaxsid.InputError, match="rigid"):
        jaxsid.cbsi(three, sensors=("velocity",) * 2, collocated=(0,))
    exact = jaxsid.cbsi(three, sensors=("velocity",) * 2, collocated=(0,), rigid=np.ones((2, 1)))
    assert np.abs(errors(exact)).max() < 1e-8
    indicators = jaxsid.modal(four).indicators
    assert indicators is not None
    assert np.sort(np.asarray(indicators.mac))[0] < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("step", [2.0, 0.5])
def test_the_slow_mode_of_the_thesis_is_the_fourth_state(step):
    """The excitation starts at 20 Hz, so the slow part of the response is in error. A fourth state takes that
    error up and makes a slow pair with the real pole -4.9, for every draw and for ERA and ERA/DC: the thesis's
    -0.94 +- 1.68j. MAC does not tell: it is 1 for both."""
    sweep = stepped_sine(20.0, 350.0, step=step, cycles=16, dt=DT, amplitude=5.0, rest=93)
    ir = jaxsid.impulse_response(rig_record(0, demand=sweep), method=jaxsid.Direct(taps=2048))
    window = {"rows": 500, "cols": 500}
    three = jaxsid.modal(jaxsid.era(ir, order=3, **window))
    assert np.imag(three.poles[0]) == 0
    for rz in (jaxsid.era(ir, order=4, **window), jaxsid.era_dc(ir, order=4, lags=100, **window)):
        four = jaxsid.modal(rz)
        assert 0.1 < np.abs(four.poles[0].imag) < 3
        assert pole_error(four.poles, POLES[1:]) < 0.01
        assert four.indicators is not None
        assert np.asarray(four.indicators.mac).min() > 0.99


def test_the_first_32768_samples_do_not_reach_the_resonance():
    """16 cycles in steps of 0.5 Hz: the sweep passes 56 Hz then, a quarter of the resonance's 214 Hz."""
    record = rig_record(0)
    u = np.asarray(record.u)[:32768, 0]
    power = np.abs(np.fft.rfft(u)) ** 2
    f = np.fft.rfftfreq(len(u), DT)
    assert power[f > 80].sum() < 1e-4 * power.sum()


@pytest.mark.slow
def test_wavelet_and_order_4_as_the_thesis_has_them():
    """32768 samples, 15 levels, from the start: no pole near the resonance."""
    record = rig_record(0)
    start = Record(record.u[:32768], record.y[:32768], DT)
    ir = jaxsid.impulse_response(start, method=jaxsid.Wavelet("db4", level=15))
    md = jaxsid.modal(jaxsid.era(ir, order=4, rows=500, cols=500))
    assert pole_error(md.poles, POLES[1:]) > 0.2
