"""The model's own elements: taken where the records bear them out, and what they make possible."""

import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import THREE, chain, error, experiment
from test_pipeline_identify import ROWS, nominal, recorded

from jaxsid import identify
from jaxsid.physical.inband_fit import MatrixFit

SYSTEM = ROWS["one force"].system
MODEL = nominal(SYSTEM, THREE)


@pytest.fixture(scope="module")
def noisy():
    return recorded(MODEL, *experiment(SYSTEM, 3))


def values(found, quantity):
    return np.array([float(v) for x, v in zip(found.elements.listed, found.elements.values, strict=True)
                     if x.quantity == quantity])  # fmt: skip


def largest_errors(found, system=SYSTEM):
    pairs = (("mass", system.mass), ("damping", system.damping), ("stiffness", system.stiffness))
    return [max(error(getattr(found.matrices, name), truth)) for name, truth in pairs]


def test_elements_that_the_records_bear_out_are_fitted_and_written(noisy):
    found = identify(MODEL, noisy)
    for quantity, truth in zip(("mass", "stiffness", "damping"), THREE, strict=True):
        np.testing.assert_allclose(
            values(found, quantity), truth, rtol=0.01 if quantity == "damping" else 1e-3
        )
    pulls = (
        found.elements.values - np.concatenate([THREE[0], THREE[2], THREE[1]])
    ) / found.elements.deviation
    assert np.abs(pulls).max() < 4
    np.testing.assert_allclose(np.diag(found.elements.correlation), 1.0)
    assert found.identified.connections == MODEL.connections
    np.testing.assert_allclose(found.identified.stiffness, values(found, "stiffness"))
    assert float(found.matrices.mass[0, 1]) == 0.0
    assert float(found.matrices_std.mass[0, 1]) == 0.0


def test_free_matrices_on_request(noisy):
    found = identify(MODEL, noisy, structure="free")
    assert found.elements is None
    assert float(found.matrices.mass[0, 1]) != 0.0
    assert max(largest_errors(found)) < 0.1


def test_a_spring_that_the_model_lacks_shows_in_free_matrices():
    extra = np.zeros((3, 3))
    extra[np.ix_([0, 2], [0, 2])] = [[60.0, -60], [-60, 60]]
    system = SYSTEM._replace(stiffness=SYSTEM.stiffness + extra)
    record = recorded(MODEL, *experiment(system, 3))
    found = identify(MODEL, record)
    assert found.elements is None
    assert any("contradict the structure" in w for w in found.warnings)
    missing, deviation = float(found.matrices.stiffness[0, 2]), float(found.matrices_std.stiffness[0, 2])
    assert abs(missing + 60.0) < 4 * deviation < 30
    told = identify(MODEL, record, structure="model")
    assert told.elements is not None
    assert any("which was asked for" in w for w in told.warnings)
    assert float(told.matrices.stiffness[0, 2]) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seen", [(0,), (0, 2), (0, 1)])
def test_bodies_without_a_sensor_follow_from_the_structure(noisy, seen):
    part = recorded(MODEL, noisy.u, noisy.y[:, seen], outputs=[f"s{i + 1}" for i in seen])
    found = identify(MODEL, part)
    mass, damping, stiffness = largest_errors(found)
    assert max(mass, stiffness) < 1e-3
    assert damping < 0.01
    assert any("follow from the model's structure" in w for w in found.warnings)


@pytest.mark.slow
def test_what_not_even_the_structure_determines_is_named():
    model = nominal(SYSTEM, THREE)
    record = recorded(model, *experiment(SYSTEM, 3))
    far = recorded(model, record.u, record.y[:, 2:], outputs=["s3"])
    found = identify(model, far)
    assert found.matrices is None
    assert any("Not even with the model's structure: b1.mass" in w for w in found.warnings)
    assert any("No sensor on b1, b2" in w for w in found.warnings)


@pytest.mark.slow
def test_a_damper_that_would_be_negative_is_left_out():
    """The nominal model has a damper to the ground where the system has none; noise makes it negative for some."""
    system = chain(THREE[0], [*THREE[1], 50.0], THREE[2])
    model = nominal(system, (THREE[0], [*THREE[1], 50.0], [*THREE[2], 1.0]))
    smallest = []
    for seed in range(1, 5):
        found = identify(model, recorded(model, *experiment(system, seed)))
        assert found.elements is not None
        last = values(found, "damping")[-1]
        deviation = float(found.elements.deviation[6])
        assert last >= 0
        assert last < 4 * deviation or (last, deviation) == (0.0, 0.0)
        smallest.append(last)
    assert min(smallest) == 0.0


def test_the_right_structure_is_seldom_contradicted():
    from jaxsid.pipeline.structure import _by_chance

    parts = {name: jnp.zeros(()) for name in MatrixFit._fields}
    fit = MatrixFit(**parts)._replace(information=jnp.eye(3))  # type: ignore[arg-type]
    drawn = np.random.default_rng(0).chisquare(6, 20000)
    rejected = np.mean([not _by_chance(float(x), 9, fit) for x in drawn])
    assert 0.008 < rejected < 0.0125
