"""A fit that leaves more than there is without its candidate begins again where that ended."""

from types import SimpleNamespace

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import chain, drive, exact
from test_gap_causes import candidate, refit

from jaxsid.gap.explain import FIRST, _compared, _no_worse
from jaxsid.gap.ranking import Whole
from jaxsid.gap.refit import Hypothesis, refitted
from jaxsid.gap.roughly import FINE
from jaxsid.mechanics.lumped import Effect

PLACE, GAIN = {"sensor": "s1"}, 1.2


def gain(factor):
    return Hypothesis((Effect("sensor_gain", tuple(PLACE.items()), {"factor": factor}),))


@pytest.fixture(scope="module")
def astray():
    """A chain one of whose sensors reads a fifth too much; a fit of that, and one that was stopped far from it."""
    y, level = colored(exact(drive()) * [1.0, GAIN, 1.0], 4)
    of = bench(y, level, model=chain())
    without, good = (refitted(of, x, steps=30) for x in (Hypothesis(), gain(1.0)))
    bad = refitted(of, gain(4.0), steps=1)
    assert bad.fit.squares > 2 * without.fit.squares
    return SimpleNamespace(bench=of, without=without, good=good, bad=bad)


def test_it_finds_what_a_good_start_finds(astray):
    found = _no_worse(Whole(astray.bench, astray.bad), astray.without).refit
    assert found.fit.evidence == pytest.approx(astray.good.fit.evidence, abs=FINE)  # at which a search ends
    (effect,) = found.hypothesis.effects
    assert float(np.asarray(effect.parameters["factor"])) == pytest.approx(GAIN, rel=0.01)


def test_what_leaves_less_stays_as_it_is(astray):
    whole = Whole(astray.bench, astray.good)
    assert _no_worse(whole, astray.without) is whole
    bad = Whole(astray.bench, astray.bad)
    assert _no_worse(bad, refit(-np.inf, squares=np.inf)) is bad


def test_a_round_counts_the_better_fit(astray):
    c, whole = candidate("sensor_gain", PLACE), Whole(astray.bench, astray.bad)
    rough, values = [(c, astray.bad)], [astray.bad.fit.evidence]
    found = _compared(rough, values, {0: whole}, astray.bench, astray.without, FIRST)
    assert found.gain > 0
    assert found.ranked[0].evidence == pytest.approx(astray.good.fit.evidence, abs=FINE)
    # of what was fitted roughly only nothing is asked
    assert _compared(rough, values, {}, astray.bench, astray.without, FIRST).gain < 0
