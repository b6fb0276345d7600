"""Numbers and units as people read them, long curves with few points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_fixture import chain

from jaxsid.digits import change, percent, significant, with_std
from jaxsid.examples.systems import one_dof, rig, three_dof
from jaxsid.mechanics.lumped import lumped_model
from jaxsid.mechanics.units import units_of
from jaxsid.report.envelope import envelope


def read(text: str) -> float:
    """The number that a text shows."""
    plain = text.replace("\N{MINUS SIGN}", "-").replace(" \N{MULTIPLICATION SIGN} 10", "e")
    return float(plain.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")))


@given(st.floats(-1e12, 1e12).filter(lambda x: abs(x) > 1e-12), st.integers(2, 8))
def test_significant_digits_keep_the_value(value, digits):
    assert read(significant(value, digits)) == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits))


@given(st.floats(1e-9, 1e9), st.floats(1e-5, 0.9))
def test_a_deviation_sets_the_digits(value, relative):
    """The value is right to a tenth of its deviation, and the deviation to two digits."""
    std = value * relative
    text = with_std(value, std).removeprefix("(")
    scale = 1.0
    if ")" in text:
        text, power = text.split(")")
        scale = read("1" + power)
    shown, deviation = (read(part) * scale for part in text.split(" ± "))
    assert abs(shown - value) <= 0.1 * std
    assert deviation == pytest.approx(std, rel=0.06)


def test_examples_of_numbers():
    assert with_std(207.41234, 0.0123) == "207.412 ± 0.012"
    assert with_std(-30030.0, 190.0) == "\N{MINUS SIGN}30030 ± 190"
    assert with_std(1.23456e9, 2.1e6) == "(1.2346 ± 0.0021) \N{MULTIPLICATION SIGN} 10⁹"
    assert with_std(2.0, float("nan")) == "2.0000"
    assert with_std(float("nan"), 1.0) == significant(float("inf")) == "\N{EN DASH}"
    assert change(110.0, 100.0) == "+10.0 %"
    assert change(1.0, 0.0) == change(float("nan"), 1.0) == "\N{EN DASH}"
    assert percent(0.012345) == "1.23\N{NO-BREAK SPACE}%"


def test_units_follow_the_names_of_the_channels():
    assert units_of(rig()).label("velocity") == "velocity (rad/s)"
    assert units_of(rig()).label("force") == "torque (N m)"
    assert units_of(chain(1.0)).label("acceleration per force") == "acceleration / force (m/s²/N)"
    assert units_of(three_dof()).symbol("mass") == "kg"
    assert units_of(one_dof()).turning is False


def test_unknown_motion_shows_both_units():
    units = units_of(lumped_model(["b"], [1.0], name="x"))
    assert units.turning is None
    assert units.label("mass") == "mass (kg or kg m²)"


@given(st.integers(1, 5000), st.integers(50, 400))
def test_an_envelope_keeps_the_extremes_in_order(samples, points):
    y = np.random.default_rng(samples).standard_normal(samples)
    x = np.arange(samples) * 0.1
    few_x, few_y = envelope(x, y, points)
    assert len(few_x) <= points + 2 * samples / points + 2
    assert few_y.min() == y.min()
    assert few_y.max() == y.max()
    assert (np.diff(few_x) >= 0).all()


def test_an_envelope_keeps_gaps():
    y = np.concatenate([np.ones(5000), np.full(5000, np.nan)])
    few = envelope(np.arange(10000.0), y, 100)[1]
    assert np.isnan(few[60:]).all()
    assert (few[:40] == 1).all()
