"""Chapter 6 of the thesis, with its window sizes: from exact responses and from its chirps to M, D, K.

The rig, whose recorded data are not published, is in test_thesis_rig.py.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_markov import CHAIN, CHAIN_ONE_INPUT, ONE, markov, pole_error, rebuilt

import jaxsid
from jaxsid.examples import exact_record, one_dof, one_dof_record, rig, three_dof, three_dof_records
from jaxsid.records import ImpulseResponse, Record

DT = 1e-3
SAMPLES = 4096


class Case(NamedTuple):
    """A system of the thesis and the windows it was identified with."""

    system: tuple[np.ndarray, ...]
    era: dict[str, int]
    era_dc: dict[str, int]

    @property
    def order(self) -> int:
        return 2 * len(self.system[0])


SHORT_BLOCKS = {"rows": 5, "cols": 3000, "lags": 100}
CASES = {
    "1 DOF": Case(ONE, {"rows": 1000, "cols": 1000}, {"rows": 500, "cols": 500, "lags": 5}),
    "3 DOF, three inputs": Case(CHAIN, {"rows": 1000, "cols": 1000}, SHORT_BLOCKS),
    "3 DOF, one input": Case(CHAIN_ONE_INPUT, {"rows": 1000, "cols": 1000}, SHORT_BLOCKS),
}


def matrices(rz, system):
    """M, D, K by CBSI, accelerometers on all bodies, the inputs on the first ones."""
    so = jaxsid.cbsi(
        rz, sensors=("acceleration",) * len(system[0]), collocated=tuple(range(system[3].shape[1]))
    )
    return so.mass, so.damping, so.stiffness


def assert_physical(rz, system, tolerance):
    for found, truth in zip(matrices(rz, system), system[:3], strict=True):
        np.testing.assert_allclose(found, truth, rtol=0, atol=tolerance * np.abs(truth).max())


def assert_exact(rz, case, *, poles, physical):
    """Poles, MAC, M, D, K and the response that the realization gives back."""
    h, true_poles = markov(case.system, SAMPLES)
    md = jaxsid.modal(rz)
    assert md.indicators is not None
    assert pole_error(md.poles, true_poles) < poles
    np.testing.assert_allclose(md.indicators.mac, 1, atol=1e-9)
    assert np.abs(rebuilt(rz, SAMPLES) - h).max() < 1e-11
    assert_physical(rz, case.system, physical)


def exact_response(case):
    return ImpulseResponse(markov(case.system, SAMPLES)[0], DT)


@pytest.mark.parametrize("name", CASES)
def test_era_from_the_exact_response(name):
    case = CASES[name]
    rz = jaxsid.era(exact_response(case), order=case.order, **case.era)
    assert_exact(rz, case, poles=1e-10, physical=1e-8)


@pytest.mark.parametrize("first_lag", [0, *(pytest.param(x, marks=pytest.mark.slow) for x in (5, 200))])
@pytest.mark.parametrize("name", CASES)
def test_era_dc_from_the_exact_response(name, first_lag):
    case = CASES[name]
    rz = jaxsid.era_dc(exact_response(case), order=case.order, first_lag=first_lag, **case.era_dc)
    assert_exact(rz, case, poles=1e-8, physical=1e-7)


@pytest.mark.parametrize("name", ["1 DOF", "3 DOF, one input"])
def test_era_by_full_decomposition(name):
    case = CASES[name]
    window = case.era if name == "1 DOF" else {"rows": 150, "cols": 450, "stride": 4}
    rz = jaxsid.era(exact_response(case), order=case.order, method="svd", **window)
    assert_exact(rz, case, poles=1e-10, physical=1e-8)


@pytest.mark.slow
def test_era_by_full_decomposition_of_3000_by_3000():
    case = CASES["3 DOF, three inputs"]
    rz = jaxsid.era(exact_response(case), order=6, method="svd", **case.era)
    assert_exact(rz, case, poles=1e-10, physical=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_era_dc_by_full_decomposition(name):
    """2500 x 2500 for 1 DOF, 1500 x 1500 for 3."""
    case = CASES[name]
    rz = jaxsid.era_dc(exact_response(case), order=case.order, method="svd", **case.era_dc)
    assert_exact(rz, case, poles=1e-8, physical=1e-7)


@pytest.mark.parametrize("name", ["1 DOF", pytest.param("3 DOF, one input", marks=pytest.mark.slow)])
@pytest.mark.parametrize("algorithm", [pytest.param("era", marks=pytest.mark.slow), "era_dc"])
def test_a_batch_gives_the_same_numbers(name, algorithm):
    """Forces in other units scale M, D and K alike and leave the poles."""
    case = CASES[name]
    h, true_poles = markov(case.system, SAMPLES)

    def identified(h):
        rz = getattr(jaxsid, algorithm)(ImpulseResponse(h, DT), order=case.order, **getattr(case, algorithm))
        return jaxsid.modal(rz).poles, matrices(rz, case.system)

    units = np.array([1.0, 4.0])
    poles, found = jax.vmap(identified)(jnp.asarray(h / units[:, None, None, None]))
    for i, unit in enumerate(units):
        assert pole_error(poles[i], true_poles) < (1e-10 if algorithm == "era" else 1e-8)
        for x, truth in zip(found, case.system[:3], strict=True):
            np.testing.assert_allclose(x[i], unit * truth, atol=1e-7 * unit * np.abs(truth).max())


def test_numbers_printed_for_one_degree_of_freedom():
    """MSV 0.9973, and s^2 / (s^2 + 0.01 s + 1) with smaller residuals in the numerator [6.8]."""
    case = CASES["1 DOF"]
    rz = jaxsid.era(exact_response(case), order=2, **case.era)
    md = jaxsid.modal(rz)
    assert md.indicators is not None
    np.testing.assert_allclose(md.indicators.msv, 0.9973, atol=5e-5)
    np.testing.assert_allclose(np.sort(np.abs(md.poles.imag)), 0.99999, atol=5e-6)
    second, first, constant = transfer_numerator(rz)
    assert abs(second - 1) < 1e-13
    assert abs(first) < 4e-11
    assert abs(constant) < 2e-12


def transfer_numerator(rz):
    """det(s I - A + B C) - (1 - D) det(s I - A), highest power first: of C (s I - A)^-1 B + D."""
    model = jaxsid.continuous(rz)
    A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
    return np.poly(A - B @ C) - (1 - D[0, 0]) * np.poly(A)


def coherence_as_printed(h, order, blocks):
    """MAC [4.45-4.50] by its formula, with a full decomposition in numpy."""
    m, r = h.shape[1:]
    at = np.arange(blocks)

    def hankel(k):
        return h[1 + k + at[:, None] + at].transpose(0, 2, 1, 3).reshape(blocks * m, blocks * r)

    u, s, vt = np.linalg.svd(hankel(0))
    root = np.sqrt(s[:order])
    A = (u[:, :order] / root).T @ hankel(1) @ (vt[:order].T / root)
    eigenvalues, psi = np.linalg.eig(A)
    q = np.linalg.solve(psi, root[:, None] * vt[:order])
    sequence = (eigenvalues[:, None] ** at)[:, :, None] * q[:, None, :r]
    sequence = sequence.reshape(order, -1)
    inner = np.abs((q * sequence.conj()).sum(axis=1))
    return inner / np.linalg.norm(q, axis=1) / np.linalg.norm(sequence, axis=1)


@pytest.mark.parametrize("name", CASES)
def test_noise_free_coherence_is_one(name):
    """The thesis prints 0.83, 0.34, 0.35 for its noise-free 3 DOF: its formula gives 1 for any window."""
    case = CASES[name]
    h = markov(case.system, 601, dt=5e-3)[0]
    np.testing.assert_allclose(coherence_as_printed(h, case.order, 150), 1, atol=1e-10)
    rz = jaxsid.era(ImpulseResponse(h, 5e-3), order=case.order, rows=150, cols=150)
    indicators = jaxsid.modal(rz).indicators
    assert indicators is not None
    np.testing.assert_allclose(indicators.mac, 1, atol=1e-10)


def chirps(name):
    """The records of the thesis, each with a column for every input."""
    if name == "1 DOF":
        return (one_dof_record(samples=SAMPLES),)
    records = three_dof_records(samples=SAMPLES)
    if name == "3 DOF, one input":
        return records[:1]
    return tuple(
        Record(np.asarray(r.u) * (np.arange(3) == j), r.y, r.dt, outputs=r.outputs)
        for j, r in enumerate(records)
    )


@pytest.mark.parametrize(
    "method", [jaxsid.Wavelet("db4", level=12), jaxsid.Direct()], ids=["wavelet", "direct"]
)
@pytest.mark.parametrize(
    "name",
    [
        "1 DOF",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("3 DOF, three inputs", "3 DOF, one input")),
    ],
)
def test_from_the_chirps(name, method):
    """The last sample is not determined by a force that starts at zero; no window here reaches it."""
    case = CASES[name]
    h, true_poles = markov(case.system, SAMPLES)
    ir = jaxsid.impulse_response(chirps(name), method=method)
    assert (
        np.abs(np.asarray(ir.h)[:-1] - h[:-1]).max() < 1e-9
    )  # of a peak of 1e-3; the thesis has a thousandth of the peak
    for rz in (
        jaxsid.era(ir, order=case.order, **case.era),
        jaxsid.era_dc(ir, order=case.order, first_lag=5, **case.era_dc),
    ):
        md = jaxsid.modal(rz)
        assert md.indicators is not None
        assert pole_error(md.poles, true_poles) < 1e-6
        np.testing.assert_allclose(md.indicators.mac, 1, atol=1e-9)
        assert_physical(rz, case.system, 1e-4)


def test_fourier_misses_the_first_second():
    """One boxcar segment over the first 40 s of the chirp, as in figure 6.5."""
    record = one_dof_record(samples=40000)
    ir = jaxsid.impulse_response(record, method=jaxsid.Fourier(segment=40000, window="boxcar"))
    truth = markov(ONE, 40000)[0][:, 0, 0]
    error = np.abs(np.asarray(ir.h)[:, 0, 0] - truth)
    assert error[1:1000].max() > np.abs(truth[1:]).max()


RIG_POLES = np.array([-4.92977952, -120.21671401 + 1343.27261883j, -120.21671401 - 1343.27261883j])
TONES = {  # frequency in Hz, well inside the band of the modes; the poles that can be found
    "1 DOF": (1.0, one_dof(), ("force",), markov(ONE, 2)[1]),
    "3 DOF": (1.0, three_dof(), ("force1",), markov(CHAIN, 2)[1]),
    "rig": (50.0, rig(), ("torque",), RIG_POLES),
}


def from_a_tone(name, level):
    """Largest relative error of the poles by the wavelet method from one sine, at rest before, with noise."""
    frequency, model, inputs, poles = TONES[name]
    tone = np.sin(2 * np.pi * frequency * DT * np.arange(SAMPLES))
    record = exact_record(model, tone, DT, inputs=inputs)
    y = np.asarray(record.y)
    y = y + level * y.std(axis=0) * np.random.default_rng(0).standard_normal(y.shape)
    ir = jaxsid.impulse_response(Record(record.u, y, DT), method=jaxsid.Wavelet("db4", level=12))
    rz = jaxsid.era(ir, order=len(poles), rows=1000, cols=1000)
    return pole_error(jaxsid.modal(rz).poles, poles)


@pytest.mark.parametrize(
    "name", [x if x == "1 DOF" else pytest.param(x, marks=pytest.mark.slow) for x in TONES]
)
def test_a_noise_free_tone_gives_the_poles(name):
    """Through its start from rest, not through the tone: see test_impulse_tone.py."""
    assert from_a_tone(name, 0.0) < 1e-8


@pytest.mark.parametrize(
    ("name", "level", "least"),
    [
        ("1 DOF", 1e-2, 0.01),
        pytest.param("3 DOF", 1e-2, 0.2, marks=pytest.mark.slow),
        pytest.param("rig", 1e-2, 0.2, marks=pytest.mark.slow),
        pytest.param("3 DOF", 1e-6, 0.01, marks=pytest.mark.slow),
        pytest.param("rig", 1e-6, 0.2, marks=pytest.mark.slow),
    ],
)
def test_a_noisy_tone_does_not(name, level, least):
    """1 % of noise: the poles of more than one mode are 20 % off; a millionth already costs percents."""
    assert from_a_tone(name, level) > least
