"""Laws that were screened with a motion far from their own: where else a search for them begins."""

import numpy as np
import pytest
from gap_helpers import JOINT, chain, drive, noisy, record, silent, with_effect
from test_gap_causes import B12, B23, candidate

from jaxsid.gap.examine import examine
from jaxsid.gap.refit import Hypothesis, bench_of, refitted
from jaxsid.gap.roughly import _hardly_bent, roughly
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Effect

TRUE = {"stiffness": 900.0, "beta": 125.0, "gamma": 125.0, "exponent": 1.0}
# yields at a fifth of the distance that the true one does, and abruptly
SCREENED = {"stiffness": 630.0, "beta": 1250.0**2.15, "gamma": 0.0, "exponent": 2.15}


def hypothesis(parameters, place=B12):
    return Hypothesis((Effect("hysteresis", tuple(place.items()), parameters),))


@pytest.fixture(scope="module")
def bench():
    u = drive()
    measured = record(u, noisy(with_effect(u, "hysteresis", JOINT, TRUE), 0.01))
    found = examine(chain(), measured)
    return bench_of(chain(), [measured], found.noises, found.fit)


@pytest.mark.slow
def test_a_loop_screened_as_yielding_too_early_is_found(bench):
    c = candidate("hysteresis", B12, **SCREENED)
    ((_, found),) = roughly(
        bench, [(c, hypothesis(SCREENED), None)], refitted(bench, Hypothesis()), 1, silent
    )
    (effect,) = found.hypothesis.effects
    assert effect.parameters["stiffness"] == pytest.approx(TRUE["stiffness"], rel=0.02)
    # that far the loop goes: beta and gamma share it as the exponent has it
    limit = (effect.parameters["beta"] + effect.parameters["gamma"]) ** (-1 / effect.parameters["exponent"])
    assert limit == pytest.approx(1 / 250, rel=0.05)
    # which a search of as many steps from what was screened does not come to
    lost = refitted(bench, hypothesis(SCREENED), steps=60)
    assert lost.fit.evidence < found.fit.evidence - 1000


def test_a_law_that_bends_later_yields_that_much_farther():
    of = Hypothesis((*hypothesis(TRUE).effects, *hypothesis(SCREENED, B23).effects), (2,))
    every = _hardly_bent(of, candidate("hysteresis", B23, **SCREENED))
    assert [h.effects[0] for h in every] == [of.effects[0]] * 2
    assert [h.wrong for h in every] == [(2,)] * 2
    for h, times in zip(every, (5, 20), strict=True):
        told = {n: float(x) for n, x in h.effects[1].parameters.items()}
        assert told["stiffness"] == SCREENED["stiffness"]
        assert told["exponent"] == 1
        assert 1 / (told["beta"] + told["gamma"]) == pytest.approx(times / 1250)


def test_what_does_not_bend_or_is_not_the_candidate_stays_as_it_is():
    spring = Hypothesis((Effect("cubic_stiffness", tuple(B12.items()), {"coefficient": 1e4}),))
    assert _hardly_bent(spring, candidate("cubic_stiffness", B12, coefficient=1e4)) == []
    assert _hardly_bent(hypothesis(SCREENED), candidate("hysteresis", B23, **SCREENED)) == []
    # a memory that grows without bound has no distance at which it yields
    assert (
        _hardly_bent(hypothesis({**SCREENED, "beta": -1.0}), candidate("hysteresis", B12, **SCREENED)) == []
    )


@pytest.mark.parametrize(
    "kind", [k for k in CATALOGUE.values() if k.hardly_bent is not None], ids=lambda k: k.name
)
def test_laws_that_bend_later_are_sensible_and_hold_less_back(kind):
    given = (2.0, 30.0, 10.0, 1.7)
    every = kind.hardly_bent(*given)
    assert every
    for x in every:
        assert kind.sensible(*x)
        assert all(np.isfinite(x))
        assert all(v >= p.lowest for v, p in zip(x, kind.parameters, strict=True))
        assert x[1] + x[2] < (given[1] + given[2]) ** (1 / given[3])
