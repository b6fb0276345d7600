"""A second effect where tests find so little that it would be of no matter by itself."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
from gap_helpers import silent
from test_gap_causes import B12, B23, BENCH, candidate, ranking, refit
from test_gap_verdict import causes, closure, examination

from jaxsid.gap import causes as module
from jaxsid.gap import look as look_of
from jaxsid.gap import null, search
from jaxsid.gap.look import Look
from jaxsid.gap.places import Place
from jaxsid.gap.search import Found

B13 = {"between": ("b1", "b3")}


def test_little_is_looked_for_where_tests_find_it_and_nothing_was_found_yet(monkeypatch):
    every = [candidate("coulomb_friction", p) for p in (B12, B13, B23)] + [
        candidate("mass_error", {"body": "b2"})
    ]
    monkeypatch.setattr(look_of, "_screened", lambda look, kinds: tuple(every))
    places = [Place("between", x["between"]) for x in (B12, B13, B23)]
    tests = [null.Test("a law", p, 1e-4) for p in (1e-8, 0.5, 1e-6)]
    scored = cast(Any, SimpleNamespace(places=tuple(places)))
    look = Look(cast(Any, "fit"), null.Null(1e-7, 1e-4, tuple(tests), ()), scored)
    assert look.clear
    assert null.told_at(look.null, places) == (places[0], places[2])
    had = ranking(0.0, kinds=[("cubic_stiffness", {"between": B12["between"][::-1]})]).ranked
    assert look_of.candidates_elsewhere(look, had) == (every[2],)
    assert look_of.candidates_elsewhere(look._replace(scored=None), had) == ()
    # of as many tests as there are one may find as much by chance
    by_chance = tuple(null.Test("a law", p, 1e-4) for p in (0.004, 0.5, 1.0))
    assert null.told_at(null.Null(0.012, 1e-4, by_chance, ()), places) == ()


@pytest.mark.parametrize(("selected", "further"), [(1, 0), (1, 1), (2, None)])
def test_one_effect_more_is_looked_for_beside_one(monkeypatch, selected, further):
    first = ranking(0.0)
    at = Found(BENCH, "clear", (first,) * selected, first.ranked[:1] * selected, refit(0.0))
    more, asked = ranking(1.0, kinds=[("coulomb_friction", B23)]), []

    def tried(at, candidates, *_):
        asked.append((at.look, candidates))
        return at._replace(selected=(*at.selected, *more.ranked[:further]))

    monkeypatch.setattr(search, "looked", lambda *_, little: "places" if little else "none")
    monkeypatch.setattr(search, "candidates_elsewhere", lambda look, found: (look, *found))
    monkeypatch.setattr(search, "_further", tried)
    monkeypatch.setattr(search, "_reconsidered", lambda at, *_: at._replace(look="again"))
    found = search.small_beside(at, BENCH.model, (), silent)
    if not further:
        assert found is at
    else:
        assert (found.look, len(found.selected)) == ("again", 2)
    assert asked == ([] if selected == 2 else [("places", ("places", *at.selected))])


@pytest.mark.parametrize(
    ("unlisted", "outrun", "more", "asked", "concluded"),
    [
        (False, False, 2, 0, [1]),
        (False, True, 2, 1, [1, 2]),
        (False, True, 1, 1, [1]),  # nothing is there
        (True, False, 2, 1, [2]),
        (True, True, 1, 1, [1]),  # once is enough
    ],
)
def test_it_is_asked_for_where_shapes_or_other_samples_show_that_something_is_left(
    monkeypatch, unlisted, outrun, more, asked, concluded
):
    first = ranking(0.0)
    look = SimpleNamespace(clear=True)
    at = Found(BENCH, cast(Any, look), (first,), first.ranked[:1], refit(0.0))
    calls, told = [], []

    def beside(at, *_):
        calls.append(at)
        return at._replace(selected=at.selected * more)

    def conclusion(at, *_):
        count = len(at.selected)
        told.append(count)
        left = closure(0.05)._replace(unsure=0.001 * outrun)
        return causes(*[first] * count, closures=[left] * count)

    monkeypatch.setattr(module, "searched", lambda *_: at)
    monkeypatch.setattr(module, "small_beside", beside)
    monkeypatch.setattr(module, "_unlisted", lambda at, *_: (Place("body", "b1"),) if unlisted else ())
    monkeypatch.setattr(module, "_concluded", conclusion)
    found = module.causes_of(BENCH.model, (), (), examination())
    assert len(calls) == asked
    assert told == concluded
    assert len(found.selected) == concluded[-1]
