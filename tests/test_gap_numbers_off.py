"""Numbers that a fit holds for off: what one quick fit says of them, against a nominal model that is wrong in one."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from gap_bench import bench, colored
from gap_helpers import chain, drive, exact

from jaxsid.gap.causes import TELLING
from jaxsid.gap.explain import NUMBERS
from jaxsid.gap.numbers_off import hint, numbers_off
from jaxsid.gap.refit import Hypothesis, refitted


def test_a_quick_fit_hints_at_the_number_that_is_off_and_at_no_other():
    """A mass 10 tolerances off; in units of the tempered gain from which on a number is taken."""
    records = colored(exact(drive()), 4)
    mass = np.array(chain().mass) * [1.0, 1.05, 1.0]
    of = bench(*records, model=eqx.tree_at(lambda m: m.mass, chain(), jnp.asarray(mass)))
    found = refitted(of, Hypothesis())
    first, *others = numbers_off(of, found)
    assert (first.kind, first.place) == ("mass_error", {"body": "b2"})
    told = hint(of, found, first, NUMBERS)
    assert told > 4 * TELLING
    assert all(hint(of, found, x, NUMBERS) < 0.5 * told for x in others)


def test_nothing_is_off_in_a_good_model():
    of = bench(*colored(exact(drive()), 4))
    assert numbers_off(of, refitted(of, Hypothesis())) == ()
