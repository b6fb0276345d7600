"""The page of effects: as in the repository, with a picture of every kind; pictures alone."""

from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from jaxsid.cli import app
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.report.effects_page import page
from jaxsid.report.plots.effects import DISPLACEMENT, FORCE, RATE, SIZES, TURN, example, force_along

DOCS = Path(__file__).parents[1] / "docs"


def swings():
    x, v = DISPLACEMENT * np.sin(TURN)[:, None] * SIZES, RATE * DISPLACEMENT * np.cos(TURN)[:, None] * SIZES
    return x, v, TURN[:, None] / RATE + 0 * x


def test_page_is_that_of_the_catalogue():
    assert (DOCS / "effects.md").read_text(encoding="utf-8") == page(), "run `make docs`"
    assert {x.stem for x in (DOCS / "effects").glob("*.svg")} == set(CATALOGUE)


def test_forces_in_the_pictures():
    x, v, t = swings()
    for name, expected in (
        ("stiffness_error", 0.3 * FORCE / DISPLACEMENT * x),
        ("mass_error", -0.3 * FORCE / DISPLACEMENT * x),
        ("cubic_stiffness", 0.3 * FORCE * (x / DISPLACEMENT) ** 3),
        ("coulomb_friction", 0.3 * FORCE * np.sign(v)),
    ):
        np.testing.assert_allclose(force_along(CATALOGUE[name], x, v, t), expected, atol=1e-4)
    assert all(np.isfinite(np.asarray(example(kind))).all() for kind in CATALOGUE.values())


def test_a_hysteresis_closes_its_loops():
    x, v, t = swings()
    force = force_along(CATALOGUE["hysteresis"], x, v, t)
    np.testing.assert_allclose(force[0], force[-1], atol=1e-3 * np.abs(force).max())
    assert (np.trapezoid(force, x, axis=0) > 0).all()  # it takes energy
    assert jnp.isfinite(force).all()


@pytest.mark.parametrize("name", ["hysteresis", "constant_load", "sensor_lag"])
def test_picture_alone(tmp_path, name):
    file = tmp_path / "picture.svg"
    assert CliRunner().invoke(app, ["effects", name, "--out", str(file)]).exit_code == 0
    text = file.read_text(encoding="utf-8")
    ElementTree.fromstring(text)
    assert name in text
    assert len(text) < 100_000


def test_another_ending_is_said(tmp_path):
    said = CliRunner().invoke(app, ["effects", "backlash", "--out", str(tmp_path / "picture.xyz")])
    assert said.exit_code == 2
    assert ".svg or .png" in said.output
