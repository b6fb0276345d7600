"""Numbers that a fit holds for off: what one quick fit says of them, against a nominal model that is wrong in one."""

from types import SimpleNamespace
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import chain, drive, exact, silent

from jaxsid.gap import search
from jaxsid.gap.examine import Examination
from jaxsid.gap.explain import NUMBERS
from jaxsid.gap.numbers_off import hint, numbers_off
from jaxsid.gap.refit import Hypothesis, refitted
from jaxsid.gap.search import TELLING


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


@pytest.mark.parametrize("selected", [(), ("law",)])
@pytest.mark.parametrize("small", [True, False])
@pytest.mark.parametrize("off", [(), ("number",)])
@pytest.mark.parametrize("finding", ["structure", "parameters"])
def test_numbers_are_asked_for_where_what_no_law_explains_is_slight(
    monkeypatch, finding, off, small, selected
):
    """A number far off may come with noise whose colour tests take for a little structure."""
    bench = SimpleNamespace(name="bench")
    asked = []

    def numbers(at, lacking, *_):
        asked.append((at.before, at.look.scored, lacking))
        return at._replace(selected=(*at.selected, *off))

    monkeypatch.setattr(search, "bench_of", lambda *_: bench)
    monkeypatch.setattr(search, "_effects", lambda at, *_: at._replace(selected=selected, before="laws"))
    monkeypatch.setattr(search, "slight", lambda found: small)
    monkeypatch.setattr(search, "refitted", lambda of, hypothesis, changes: (hypothesis, changes))
    monkeypatch.setattr(search, "changes_found", lambda found: "changes")
    monkeypatch.setattr(search, "attached_candidates", lambda look: ["spring"] * 9)
    monkeypatch.setattr(search, "_numbers", numbers)
    nothing = dict.fromkeys(Examination._fields)
    told = {"noises": (), "fit": "fit", "null": "null", "scored": "places", "finding": finding}
    examined = Examination(**cast(Any, {**nothing, **told}))
    found = search.searched(chain(), (), examined, silent)
    alone = ((Hypothesis(), "changes"), None, ["spring"] * search.LACKING)
    beside = ("laws", "places", ())
    if finding == "parameters":
        assert asked == [alone]
        assert found.selected == off
    elif selected or not small:
        assert asked == [beside]
        assert found.selected == (*selected, *off)
    else:
        assert asked == [alone]
        # where no number is off all stays as the laws left it
        assert found.selected == off
        assert found.before == (alone[0] if off else "laws")
