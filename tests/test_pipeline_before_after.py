"""What `identify` says besides the fit: nothing refined, the models compared, their residuals, what they miss."""

import numpy as np
import pytest
from band_limited import DT, THREE, System, band_noise, chain, coloured, experiment, respond
from test_pipeline_identify import nominal, recorded

from jaxsid import InputError, identify, refine
from jaxsid.mechanics.lumped import second_order
from jaxsid.pipeline.misses import cross_peaks

SYSTEM = chain(*THREE)
MISSES = "misses something that the inputs drive"


@pytest.fixture(scope="module")
def model():
    return nominal(SYSTEM, THREE)


@pytest.fixture(scope="module")
def record(model):
    return recorded(model, *experiment(SYSTEM, 3))


@pytest.fixture(scope="module")
def refined(model, record):
    return identify(model, record)


@pytest.fixture(scope="module")
def unrefined(model, record):
    return identify(model, record, refine=False)


def misfit(matrices, record, start=None):
    """rms(y - yhat) / std(y) by scipy's simulation and numpy's least squares for the initial state."""
    system = System(*(np.asarray(x) for x in matrices), SYSTEM.driven, SYSTEM.kinds)
    u, y = np.asarray(record.u), np.asarray(record.y)
    left = y - respond(system, u)
    free = np.stack([respond(system, 0 * u, state=x).ravel() for x in np.eye(6)], axis=1)
    if start is None:
        left = left - (free @ np.linalg.lstsq(free, left.ravel(), rcond=None)[0]).reshape(y.shape)
    return np.sqrt((left**2).mean(axis=0)) / y.std(axis=0)


def of(model):
    return model.mass, model.damping, model.stiffness


def test_each_model_is_compared_from_its_own_initial_state(model, record, refined):
    np.testing.assert_allclose(refined.nominal_nrmse, misfit(of(second_order(model)), record), rtol=1e-6)
    np.testing.assert_allclose(refined.cbsi_nrmse, misfit(of(refined.cbsi), record), rtol=1e-6)
    np.testing.assert_allclose(refined.matrices_nrmse, misfit(of(refined.matrices), record), rtol=1e-6)
    assert (np.asarray(refined.nominal_nrmse) > 0.3).all()
    rest = identify(model, record, initial="rest")
    np.testing.assert_allclose(rest.nominal_nrmse, misfit(of(second_order(model)), record, "rest"), rtol=1e-6)


def test_a_model_that_runs_away_has_no_number(record):
    rising = [*THREE[:2], [-900.0, 1.2, 1.0]]
    matrices = nominal(chain(*rising))
    assert np.isnan(np.asarray(identify(matrices, record, structure="free").nominal_nrmse)).all()


def test_without_refinement_cbsi_has_the_last_word(refined, unrefined):
    assert refined.refined
    assert not unrefined.refined
    for name in ("mass", "damping", "stiffness"):
        np.testing.assert_array_equal(getattr(unrefined.matrices, name), getattr(refined.cbsi, name))
        held = np.asarray(getattr(unrefined.identified.matrices, name))
        raw = np.asarray(getattr(unrefined.cbsi, name))
        np.testing.assert_allclose(held, 0.5 * (raw + raw.T))
    assert (
        unrefined.matrices_std is unrefined.elements is unrefined.entries is unrefined.matrices_nrmse is None
    )
    assert np.isfinite(np.asarray(unrefined.frequency_std)).all()
    np.testing.assert_allclose(unrefined.cbsi_nrmse, refined.cbsi_nrmse)
    np.testing.assert_allclose(
        unrefined.matrices.stiffness, SYSTEM.stiffness, atol=0.01 * SYSTEM.stiffness[0, 0]
    )
    for told in ("Nothing was refined", "no standard deviations", "CBSI alone"):
        assert any(told in w for w in unrefined.warnings), told
    assert not any("refined" in w for w in refined.warnings)


@pytest.mark.slow
def test_without_refinement_missing_sensors_leave_no_matrices(model, record):
    seen = recorded(model, record.u, np.asarray(record.y)[:, :2], outputs=["s1", "s2"])
    found = identify(model, seen, refine=False)
    assert found.matrices is found.cbsi is found.identified is found.cbsi_nrmse is None
    assert found.nominal_nrmse.shape == (2,)
    for told in ("No sensor on b3", "Nothing was refined", "Only the fit that was left out"):
        assert any(told in w for w in found.warnings), told
    assert len(found.modal.poles) == 6


def test_a_structure_cannot_be_asked_for_without_a_fit(model, record):
    with pytest.raises(InputError, match=r"refine=False leaves out: choose one"):
        identify(model, record, refine=False, structure="model")


def test_entries_of_free_matrices(model, record):
    found = identify(model, record, structure="free")
    entries = {x.name: i for i, x in enumerate(found.entries.listed)}
    assert len(entries) == 18
    old = second_order(model)
    for name, which, i, j in (("b1.mass", "mass", 0, 0), ("b2, b3.stiffness", "stiffness", 1, 2)):
        at = entries[name]
        assert float(found.entries.values[at]) == float(getattr(found.matrices, which)[i, j])
        np.testing.assert_allclose(
            found.entries.deviation[at], getattr(found.matrices_std, which)[i, j], rtol=1e-9
        )
        assert float(found.entries.nominal[at]) == float(getattr(old, which)[i, j])
    np.testing.assert_allclose(np.diag(np.asarray(found.entries.correlation)), 1.0)
    # the sum of a row is what joins a body to the ground: its deviation follows from those of the entries
    row = [entries[x] for x in ("b1.stiffness", "b1, b2.stiffness", "b1, b3.stiffness")]
    std, rho = (
        np.asarray(found.entries.deviation)[row],
        np.asarray(found.entries.correlation)[np.ix_(row, row)],
    )
    np.testing.assert_allclose(std @ rho @ std, float(found.matrices_std.ground_stiffness[0]) ** 2, rtol=1e-6)


def test_residuals_are_those_of_the_prediction(record, refined):
    (left,) = refined.residuals
    e = np.asarray(record.y - refined.predictions[0])
    e = (e - e.mean(axis=0)) / e.std(axis=0)
    np.testing.assert_allclose(
        left.autocorrelation[5], (e[5:] * e[:-5]).mean(axis=0) * (1 - 5 / len(e)), rtol=1e-9
    )
    inside = np.abs(np.asarray(left.cross_correlation)) < np.asarray(left.cross_limit)
    assert inside.mean() > 0.97


def with_another_mass(seed, samples=20000):
    """Three sensed masses of four: the last hangs on the third, where nothing sees it. Its resonance is all but on the
    poles of the model that fits best, so that only what lies around it tells."""
    whole = chain([*THREE[0], 0.2], [*THREE[1], 900.0], [*THREE[2], 0.5])
    rng = np.random.default_rng(seed)
    u = band_noise(rng, samples, 1)
    y = respond(whole, u)[:, :3]
    return u, y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)


@pytest.mark.slow
def test_a_mass_that_the_model_lacks_is_missed(model):
    record = recorded(model, *with_another_mass(1))
    found = identify(model, record)
    (text,) = (w for w in found.warnings if MISSES in w)
    (peaks,) = cross_peaks(found.residuals)
    worst = int(peaks.score[:, 0].argmax())
    assert f"s{worst + 1} with f1, correlation {peaks.value[worst, 0]:.2g} at a lag of" in text
    assert peaks.score.max() > 1.3 * peaks.limit
    (text,) = (w for w in refine(model, record, validate=False).warnings if MISSES in w)
    assert "with f1" in text


@pytest.mark.slow
@pytest.mark.parametrize("colour", [None, "low", "high"])
def test_right_models_miss_nothing(model, colour):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = band_noise(rng, 20000, 1)
        y = respond(SYSTEM, u)
        y = y + 0.03 * y.std(axis=0) * coloured(rng, y.shape, colour)
        found = identify(model, recorded(model, u, y, DT))
        assert not any(MISSES in w for w in found.warnings)
