"""The structures of the studies against closed forms and published frequencies."""

import numpy as np
import pytest
import scipy.linalg

from jaxsid.checks import InputError
from jaxsid.examples.structures import chain, galileo, mini_mast, railway_vehicle, turbine_generator
from jaxsid.mechanics.lumped import second_order


def modes(model):
    """Frequencies (Hz) and damping ratios by a generalized eigenvalue problem of twice the size."""
    so = second_order(model)
    mass, damping, stiffness = (np.asarray(x) for x in (so.mass, so.damping, so.stiffness))
    zero = np.zeros_like(mass)
    poles = scipy.linalg.eigvals(
        np.block([[-damping, -stiffness], [mass, zero]]), scipy.linalg.block_diag(mass, mass)
    )
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))]
    return np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)


@pytest.mark.parametrize("bodies", [1, 2, 7])
def test_chain(bodies):
    w = 20 * np.sin(np.arange(1, bodies + 1) * np.pi / (2 * bodies + 2))
    frequencies, damping = modes(chain(bodies))
    np.testing.assert_allclose(frequencies, w / (2 * np.pi), rtol=1e-12)
    np.testing.assert_allclose(damping, 1e-3 * w, rtol=1e-9)
    with pytest.raises(InputError, match="a mass at least"):
        chain(0)


def test_railway_vehicle():
    so = second_order(railway_vehicle())
    heave, pitch = np.array([1, 1, 0, 0]), np.array([0.5, -0.5, 0, 0]) * 19.0  # one metre, one radian
    np.testing.assert_allclose(heave @ so.mass @ heave, 32e3, rtol=1e-12)
    np.testing.assert_allclose(pitch @ so.mass @ pitch, 1.97e6, rtol=1e-12)
    np.testing.assert_allclose(heave @ so.mass @ pitch, 0, atol=1e-9)
    np.testing.assert_allclose(heave @ so.stiffness @ heave, 2 * 860e3)
    np.testing.assert_allclose(np.asarray(so.stiffness).sum(axis=1), [0, 0, 4.88e6, 4.88e6], atol=1e-6)
    frequencies, damping = modes(railway_vehicle())
    np.testing.assert_allclose(frequencies, [1.08, 1.31, 6.51, 7.42], rtol=2e-3)
    np.testing.assert_allclose(damping, [0.134, 0.162, 0.212, 0.239], rtol=5e-3)


def test_turbine_generator_has_the_published_frequencies():
    frequencies, damping = modes(turbine_generator())
    np.testing.assert_allclose(frequencies[1:], [15.71, 20.21, 25.55, 32.28, 47.46], rtol=6e-3)
    assert 1.4 < frequencies[0] < 1.7
    assert (damping > 0.003).all()
    assert (damping < 0.01).all()


@pytest.mark.parametrize(
    ("make", "shape", "excited", "band"),
    [(mini_mast, (18, 3), 5, (0.8, 6.3)), (galileo, (162, 1), 15, (13, 45))],
)
def test_modal_structures(make, shape, excited, band):
    structure = make()
    A, B, C, D = (np.asarray(getattr(structure.model, name)) for name in "ABCD")
    assert D.shape == shape == (len(structure.outputs), len(structure.inputs))
    poles = np.linalg.eigvals(A)
    for frequency, damping in zip(structure.frequencies, structure.damping_ratios, strict=True):
        w = 2 * np.pi * frequency
        assert np.abs(poles - w * (-damping + 1j * np.sqrt(1 - damping**2))).min() < 1e-9 * w
    assert len(structure.frequencies) == excited
    assert band[0] <= min(structure.frequencies)
    assert max(structure.frequencies) < band[1]
    assert (B.shape, C.shape) == ((len(A), shape[1]), (shape[0], len(A)))


def test_accelerations_and_displacements():
    """A constant force in the end moves and does not accelerate; accelerometers feel a force at once."""
    for structure, accelerometers in ((mini_mast(), False), (galileo(), True)):
        A, B, C, D = (np.asarray(getattr(structure.model, name)) for name in "ABCD")
        still = D - C @ np.linalg.solve(A, B)
        assert np.abs(D).max() > 0 if accelerometers else not D.any()
        assert (np.abs(still).max() < 1e-9 * np.abs(C).max()) == accelerometers


def test_the_weak_modes_of_galileo_are_weak():
    A, B, C = (np.asarray(getattr(galileo().model, name)) for name in "ABC")
    strength = np.array(
        [np.linalg.norm(C[:, i : i + 2]) * np.linalg.norm(B[i : i + 2]) for i in range(0, 90, 2)]
    )
    strength /= np.sqrt(np.diag(-A)[1::2])
    assert strength[::3].min() > 20 * np.delete(strength, np.s_[::3]).max()
