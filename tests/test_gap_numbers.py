"""Numbers of the nominal model that records contradict: a factor shared with a gain, and what is off beside it."""

import equinox as eqx
import numpy as np
import pytest
from gap_helpers import chain, drive, exact, noisy, record

from jaxsid.gap.examine import examine
from jaxsid.gap.numbers import at_the_least, off_numbers
from jaxsid.gap.words import about_numbers, percent
from jaxsid.physical.elements import Element, ElementValues
from jaxsid.records import as_array

LISTED = tuple(Element(e, q) for q, e in (("mass", "a"), ("mass", "b"), ("damping", "c"), ("stiffness", "c")))
NOMINAL = np.array([2.0, 3.0, 0.5, 100.0])


def values(factors, spread=0.001):
    value = NOMINAL * factors
    return ElementValues(
        LISTED, as_array(value), as_array(spread * value), as_array(np.eye(4)), as_array(NOMINAL)
    )


def test_a_common_factor_is_told_from_what_is_off_beside_it():
    off = off_numbers(values([1.5, 1.52, 0.3, 1.5]))
    assert off.common == pytest.approx(1.5)
    assert [name for name, _ in off.others] == ["c.damping"]
    assert off.others[0][1] == pytest.approx(0.2)


def test_there_is_none_where_numbers_go_apart():
    off = off_numbers(values([0.6, 1.0, 1.0, 1.6]))
    assert off.common == 1
    assert {name for name, _ in off.others} == {"a.mass", "c.stiffness"}


def test_what_is_not_sure_or_small_is_not_named():
    assert off_numbers(values([1.3, 1.3, 3.0, 1.3], spread=1.0)) == (1.0, ())
    assert off_numbers(values([1.03, 0.98, 1.05, 1.02])) == (1.0, ())


def test_signs_and_absent_numbers_are_left_alone():
    odd = ElementValues(
        LISTED,
        as_array([2.0, 3.0, -0.1, 5.0]),
        as_array(np.full(4, 1e-3)),
        as_array(np.eye(4)),
        as_array([2.0, 3.0, 0.5, 0.0]),
    )
    assert off_numbers(odd) == (1.0, ())
    assert at_the_least(odd) == ()


def test_numbers_that_fits_made_as_small_as_they_may_be_are_named():
    assert at_the_least(values([1.5, 0.05, 0.05, 0.0501])) == ("b.mass", "c.damping")


@pytest.mark.slow
def test_a_deviation_at_the_least_value_is_said_to_tell_nothing():
    """The first damper has a hundredth of what the model has it."""
    u, right = drive(), chain()
    y = noisy(exact(u), 0.001)
    wrong = eqx.tree_at(lambda m: m.damping, right, right.damping * np.array([100.0, 1.0, 1.0]))
    found = examine(wrong, record(u, y))
    assert at_the_least(found.elements) == ("c1.damping",)
    assert "0.05 times the nominal value: c1.damping. " in about_numbers(found)[-1]


@pytest.mark.slow
def test_a_record_in_raw_units_says_that_a_gain_does_the_same():
    """A spring is half as stiff as the model has it, and the force 1.6 times smaller than the record says."""
    u = drive()
    y = noisy(exact(u))
    found = examine(chain(factor=np.array([2.0, 1.0, 1.0])), record(1.6 * u, y))
    assert found.far_off
    gain, far = about_numbers(found)
    assert "1.6 times" in gain
    assert "c1.stiffness 0.5" in far
    assert "Run identify first" in far


def test_a_gain_alone_is_said_to_be_one():
    u = drive()
    found = examine(chain(), record(1.6 * u, noisy(exact(u))))
    off = off_numbers(found.elements)
    assert off.common == pytest.approx(1.6, rel=0.02)
    assert "A gain of the inputs" in about_numbers(found)[0]


def test_a_good_model_is_not_talked_about():
    u = drive()
    assert about_numbers(examine(chain(), record(u, noisy(exact(u))))) == []


@pytest.mark.parametrize(
    ("share", "said"), [(1.2379, "120 %"), (0.00022, "0.022 %"), (0.742, "74 %"), (0.0, "0 %")]
)
def test_shares_are_written_without_powers_of_ten(share, said):
    assert percent(share) == said
