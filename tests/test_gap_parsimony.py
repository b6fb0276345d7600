"""Which law is taken where what is left is no noise: one of more numbers must leave clearly less."""

from types import SimpleNamespace

import numpy as np
import pytest
from gap_helpers import silent
from test_gap_causes import B12, B23, BENCH, candidate, refit

from jaxsid.gap import explain, search
from jaxsid.gap import ranking as ranking_of
from jaxsid.gap.explain import TEMPERATURE
from jaxsid.gap.ranking import (
    LOUD,
    NUMBER,
    PIECES,
    Whole,
    ends_of,
    notable,
    parsimonious,
    ranked,
)
from jaxsid.gap.search import Found


def misfit(*laws, without=100.0):
    """A round in noise of unit size: kind, place, evidence, and rms that is left of all records, best first."""
    every = [
        (candidate(kind, place), refit(evidence, 1000.0 * left**2), evidence, left)
        for kind, place, evidence, left in laws
    ]
    return ranked(every, refit(-1e9, 1000.0 * without**2), BENCH, TEMPERATURE)


def order(found):
    return [x.kind for x in found.ranked]


STRIBECK, COULOMB = ("stribeck_friction", B12, 0.0), ("coulomb_friction", B12, -1e6)


def test_a_law_of_more_numbers_must_leave_clearly_less():
    found = parsimonious(misfit((*STRIBECK, 11.52), (*COULOMB, 12.05)))
    assert order(found) == ["coulomb_friction", "stribeck_friction"]
    odds = PIECES * np.log(np.sqrt((12.05**2 - 1) / (11.52**2 - 1))) - 2 * NUMBER
    assert found.ranked[1].probability == pytest.approx(1 / (1 + np.exp(-odds)), rel=1e-6)
    assert order(parsimonious(misfit((*STRIBECK, 6.0), (*COULOMB, 12.05)))) == [STRIBECK[0], COULOMB[0]]


def test_of_laws_with_as_many_numbers_that_which_leaves_less_comes_first():
    found = parsimonious(misfit((*COULOMB, 20.0), ("quadratic_damping", B12, 0.0, 10.0)))
    assert order(found) == ["quadratic_damping", "coulomb_friction"]
    assert found.ranked[1].probability == pytest.approx(0.5**PIECES, rel=0.2)


def test_laws_elsewhere_keep_their_evidence():
    found = parsimonious(misfit((*STRIBECK, 11.5), (*COULOMB, 12.0), ("coulomb_friction", B23, -5.0, 11.6)))
    assert [(x.kind, x.evidence) for x in found.ranked if x.place == B23] == [("coulomb_friction", -5.0)]
    # a load on a body and friction between it and the ground act at one place
    assert ends_of({"body": "b1"}) == ends_of({"between": ("ground", "b1")}) != ends_of({"sensor": "b1"})


def test_a_law_alone_at_its_place_stays():
    first = misfit((*STRIBECK, 11.5), ("coulomb_friction", B23, -5.0, 12.0))
    assert parsimonious(first) is first


def test_laws_that_leave_noise_are_compared_by_evidence():
    first = misfit((*STRIBECK, 0.9 * LOUD), (*COULOMB, 0.95 * LOUD))
    assert parsimonious(first) is first
    assert explain.plainer(first, None, explain.FIRST) is first
    assert notable(misfit(("cogging_ripple", B12, 0.0, 0.9 * LOUD), without=0.91 * LOUD))


def test_a_further_law_must_leave_clearly_less_than_there_was():
    assert notable(misfit(("cogging_ripple", B12, 0.0, 50.0)))
    assert not notable(misfit(("cogging_ripple", B12, 0.0, 80.0)))  # of three numbers
    assert notable(misfit(("cubic_stiffness", B12, 0.0, 80.0)))
    assert not notable(misfit(("cubic_stiffness", B12, 0.0, 95.0)))


@pytest.fixture
def simpler(monkeypatch):
    """Stribeck's law won a round in which others had rough fits only; thorough ones leave what is told."""

    def run(lefts):
        kinds = ["stribeck_friction", "hysteresis", "quadratic_damping", "coulomb_friction", "backlash"]
        every = [(candidate(k, B12), refit(-float(i), 1.3e5), -float(i), 11.5) for i, k in enumerate(kinds)]
        # a rough fit has states of one block
        every[1:] = [
            (c, r._replace(fit=r.fit._replace(states=(np.zeros(1),))), e, left) for c, r, e, left in every[1:]
        ]
        first = ranked(every, refit(-1e9), BENCH, TEMPERATURE)
        fitted = []

        def whole(bench, hypothesis, start, effort):
            fitted.append(hypothesis)
            kind = kinds[2 + len(fitted) - 1]
            return Whole(BENCH, refit(-1e5, 1000.0 * lefts[kind] ** 2))

        monkeypatch.setattr(explain, "_whole", whole)
        monkeypatch.setattr(explain, "changes_of", lambda found, bench: None)
        monkeypatch.setattr(explain, "side_by_side", lambda f, xs: [f(x) for x in xs])
        for module in (explain, ranking_of):
            monkeypatch.setattr(module, "gauge", lambda bench: 0.0)
            monkeypatch.setattr(module, "volume", lambda bench: 0.0)
        return explain.plainer(first, None, explain.FIRST), fitted

    return run


def test_laws_of_fewer_numbers_are_fitted_to_all_records(simpler):
    found, fitted = simpler({"quadratic_damping": 30.0, "coulomb_friction": 12.0})
    assert len(fitted) == 2  # hysteresis has more numbers, and backlash comes third
    assert found.ranked[0].kind == "coulomb_friction"
    assert found.ranked[0].left == pytest.approx(12.0)


def test_the_best_law_stays_where_simpler_ones_leave_much_more(simpler):
    found, _ = simpler({"quadratic_damping": 30.0, "coulomb_friction": 25.0})
    assert found.ranked[0].kind == "stribeck_friction"


@pytest.fixture
def taken(monkeypatch):
    """What is taken of a round that Stribeck's law won, where more is left and simpler laws are as told."""

    def run(plain, clear=False, selected=(), diverging=(), most=1.0, p_value=0.0):
        first = misfit((*STRIBECK, 11.5))
        look = SimpleNamespace(clear=clear, null=SimpleNamespace(p_value=p_value))

        def take(self, of):
            best = of.ranked[0]
            last = refit(-np.inf) if best.kind in diverging else best.refit
            return self._replace(rounds=(of,), selected=(*self.selected, best), before=last)

        monkeypatch.setattr(Found, "taken", take)
        monkeypatch.setattr(search, "looked", lambda *_: look)
        monkeypatch.setattr(search, "rank", lambda *_: first)
        monkeypatch.setattr(search, "worth", lambda of, least: least < most)
        monkeypatch.setattr(search, "_least", lambda look: 0.0)
        monkeypatch.setattr(search, "plainer", lambda *_: plain)
        at = Found(BENCH, look, (), selected, refit(0.0) if selected else None)
        return at, search._further(at, (), explain.FIRST, BENCH.model, (), silent)

    return run


def test_the_simpler_law_is_taken_in_place_of_the_best_one(taken):
    plain = misfit(("coulomb_friction", B12, 0.0, 12.0), (*STRIBECK, 11.5))
    assert [x.kind for x in taken(plain)[1].selected] == ["coulomb_friction"]
    assert [x.kind for x in taken(plain, clear=True)[1].selected] == ["stribeck_friction"]


def test_laws_under_which_the_motion_grows_without_bound_are_not_taken(taken):
    plain = misfit(("coulomb_friction", B12, 0.0, 12.0), (*STRIBECK, 11.5))
    assert [x.kind for x in taken(plain, diverging=("coulomb_friction",))[1].selected] == [
        "stribeck_friction"
    ]
    at, found = taken(plain, diverging=("stribeck_friction",))
    assert (found.selected, found.before) == (at.selected, at.before) == ((), None)


def test_the_best_law_has_its_probability_beside_simpler_ones(taken):
    plain = misfit((*STRIBECK, 6.0), ("coulomb_friction", B12, -1.0, 12.0))
    _, found = taken(plain)
    assert found.rounds == (plain,)
    assert found.selected[0].probability == plain.ranked[0].probability < 1


def test_a_further_law_that_leaves_hardly_less_is_refused(taken):
    known = misfit(("constant_load", B12, 0.0, 20.0)).ranked
    at, found = taken(misfit((*STRIBECK, 90.0)), selected=known)
    assert found.selected == at.selected
    assert len(taken(misfit((*STRIBECK, 30.0)), selected=known)[1].selected) == 2


def test_a_further_law_that_is_little_is_taken_elsewhere_if_tests_find_nothing_beside_it(taken):
    there = misfit(("constant_load", {"body": "b3"}, 0.0, 20.0)).ranked
    plain = misfit((*STRIBECK, 30.0))

    def count(**given):
        return len(
            taken(plain, **{"clear": True, "most": search.LEAST, "selected": there, **given})[1].selected
        )

    assert count(p_value=0.3) == 2
    assert count(p_value=1e-4) == 1
    assert count(p_value=0.3, selected=misfit(("constant_load", B12, 0.0, 20.0)).ranked) == 1
    assert count(p_value=0.3, most=0.0) == 1
    # one that is not little may leave something for others
    assert count(p_value=1e-4, most=1.0) == 2
