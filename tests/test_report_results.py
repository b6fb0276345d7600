"""identification.json and the summary for the terminal."""

import dataclasses
import io
import json

import jax.numpy as jnp
import numpy as np
import pytest
from report_fixture import WARNING, identification, without_matrices
from rich.console import Console

from jaxsid.files.results_json import write_json
from jaxsid.report.results import identification_json
from jaxsid.report.summary import print_summary


@pytest.fixture(scope="module")
def found():
    return identification()


def test_schema_of_the_contract(found, tmp_path):
    path = tmp_path / "identification.json"
    write_json(path, identification_json(found))
    data = json.loads(path.read_text())
    assert next(iter(data)) == "schema"
    assert data["schema"] == 1
    assert data["order"] == 6
    assert data["order_reason"] == found.order_reason
    assert len(data["modes"]) == 3
    for mode in data["modes"]:
        assert {"frequency_hz", "damping_ratio", "pole", "mac", "emac", "mpc", "msv", "std"} <= set(mode)
        assert set(mode["std"]) == {"frequency_hz", "damping_ratio", "pole", "shape"}
        assert mode["pole"][1] > 0
        assert mode["frequency_hz"] == pytest.approx(np.hypot(*mode["pole"]) / (2 * np.pi))
        assert mode["damping_ratio"] == pytest.approx(-mode["pole"][0] / np.hypot(*mode["pole"]))
        assert mode["std"]["frequency_hz"] == pytest.approx(2e-4 * mode["frequency_hz"])
    assert np.allclose(np.array(data["poles"]) @ [1, 1j], found.modal.poles)
    for which in ("mass", "damping", "stiffness"):
        assert np.array_equal(data[which], getattr(found.matrices, which))
        assert np.array_equal(data["std"][which], getattr(found.matrices_std, which))
    first = data["modes"][0]
    assert first["std"]["pole"] == [found.pole_std[0].real, found.pole_std[0].imag]
    assert max(abs(complex(*x)) for x in first["shape"].values()) == pytest.approx(1.0)
    assert first["std"]["shape"]["acc2"] == [0.002, 0.001]
    more = {"nominal_nrmse", "cbsi_nrmse", "matrices_nrmse"}
    assert set(data["fit"]) == {"train_nrmse", "noise_floor"} | more
    assert data["fit"]["train_nrmse"]["acc3"] == float(found.train_nrmse[2])
    assert data["warnings"] == [WARNING]
    assert data["bodies"] == ["base", "middle", "top"]
    assert data["cbsi"]["diagnostics"]["mass_asymmetry"] == pytest.approx(1e-3)
    assert np.array_equal(data["state_space"]["A"], found.continuous.A)


def test_what_is_unknown_is_null(found):
    bare = without_matrices(found)
    nan = jnp.full(6, jnp.nan)
    unknown = {"pole_std": nan + 0j, "shape_std": jnp.full((3, 6), jnp.nan + 0j)}
    data = identification_json(dataclasses.replace(bare, frequency_std=nan, damping_ratio_std=nan, **unknown))
    json.dumps(data, allow_nan=False)
    assert data["mass"] is data["damping"] is data["stiffness"] is data["std"] is data["cbsi"] is None
    assert data["modes"][0]["mac"] is data["modes"][0]["std"]["frequency_hz"] is None


def test_a_real_pole_is_one_mode(found):
    modal = dataclasses.replace(
        found.modal,
        poles=jnp.array([-3 + 0j, -1 + 10j, -1 - 10j]),
        frequencies=jnp.array([3, 101**0.5, 101**0.5]),
        damping_ratios=jnp.array([1, 101**-0.5, 101**-0.5]),
        participation=found.modal.participation[:3],
        shapes=found.modal.shapes[:, :3],
        indicators=None,
    )
    few = jnp.full(3, 0.1)
    spread = {"frequency_std": few, "damping_ratio_std": few, "pole_std": few + 0j}
    data = identification_json(
        dataclasses.replace(found, modal=modal, shape_std=found.shape_std[:, :3], **spread)
    )
    assert [mode["pole"] for mode in data["modes"]] == [[-3, 0], [-1, 10]]
    assert len(data["poles"]) == 3
    assert data["modes"][0]["damping_ratio"] == 1


@pytest.mark.parametrize("width", [60, 120])
def test_summary_shows_modes_matrices_fit_and_warnings(found, width):
    stream = io.StringIO()
    print_summary(found, Console(file=stream, width=width))
    text = stream.getvalue()
    assert max(map(len, text.splitlines())) <= width
    words = " ".join(text.split())
    for wanted in (
        "order 6",
        "three-mass <chain>",
        "acc3",
        "<noisy>",
        "Warnings",
        "Modes",
        "Fit",
        "Stiffness (N/m)",
    ):
        assert wanted in words


def test_summary_without_matrices(found):
    stream = io.StringIO()
    print_summary(dataclasses.replace(without_matrices(found), warnings=()), Console(file=stream, width=100))
    assert "Stiffness" not in stream.getvalue()
    assert "Warnings" not in stream.getvalue()
