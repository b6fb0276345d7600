"""Real records through the whole chain: what was published of the system comes out."""

from pathlib import Path

import numpy as np
import pytest

import jaxsid


def identified(folder: Path):
    model = jaxsid.read_model(folder / "model.toml")
    return jaxsid.identify(model, jaxsid.read_records(folder / "records.toml", model))


@pytest.mark.slow
def test_frame_whose_floors_were_measured_one_after_another(data: Path):
    """Peaks of the measured frequency responses: 3.17, 9.1, 13.43 Hz."""
    found = identified(data / "cambridge_frame")
    poles = np.asarray(found.modal.poles)
    frequencies = np.sort(np.abs(poles[poles.imag > 0])) / (2 * np.pi)
    np.testing.assert_allclose(frequencies, [3.17, 9.1, 13.43], rtol=0.01)
    assert found.matrices is not None
    assert np.linalg.eigvalsh(np.asarray(found.matrices.mass))[0] > 0
    assert len(found.records) == 3
    assert any("edge" in w for w in found.warnings)


def test_free_axis_with_a_friction_that_the_model_lacks(data: Path):
    """Published mass 95.11 kg; Coulomb friction, which no linear model has, is left over and seen in the fit."""
    found = identified(data / "emps")
    assert found.matrices is not None
    assert float(found.matrices.mass[0, 0]) == pytest.approx(95.11, rel=0.05)
    assert float(found.train_nrmse[0]) > 5 * float(found.noise_floor[0])
