"""The search of fits: what it expects of a full step, and that its damping does not end it."""

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import DT, SAMPLES, SENSED, chain, drive, exact, record

from jaxsid.gap.fit import _evaluated, _expected, _step, links_of
from jaxsid.gap.noise import Noise
from jaxsid.gap.refit import Hypothesis, prior_of, refitted, shot_of
from jaxsid.gap.setting import slowest_rate
from jaxsid.gap.windows import blocks_of, window_length
from jaxsid.mechanics.lumped import Effect


def test_what_a_search_expects_is_what_a_full_step_brings():
    """So that a step which its damping holds back does not end it."""
    y, level = colored(exact(drive()), 2)
    of, nothing = bench(y, level, wide=True), Hypothesis()
    shot, links = shot_of(of, ()), links_of(())
    prior, elements = prior_of(of, nothing, shot), len(of.tolerance)
    begin = np.pad(np.full(elements, 1e-3), (0, shot.coordinates.centre.size))
    states = [np.pad(s, ((0, 0), (0, 2 * shot.slots.count))) for s in of.states]
    given = shot, of.blocks, links, prior
    at = _evaluated(*given, begin, states, 1)
    costs = []
    for damping in (1e-9, 1e3):
        move, moves = _step(at, prior, links, damping)
        new = _evaluated(*given, begin + move, [a + b for a, b in zip(states, moves, strict=True)], 1)
        costs.append(new.cost)
        assert sum(_expected(new, prior, links)) == pytest.approx(
            new.cost - costs[0], rel=0.02, abs=1e-3 * at.cost
        )
    assert sum(_expected(at, prior, links)) == pytest.approx(at.cost - costs[0], rel=0.02)
    assert at.cost > costs[1] > costs[0]


def test_evidence_is_that_of_all_unknowns_and_states_at_once():
    """Laplace with one dense matrix, the states before the record's start likely to be smaller than others."""
    y, level = colored(exact(drive()), 2)
    of = bench(y, level, wide=True)
    found = refitted(of, Hypothesis(), steps=60)
    shot = shot_of(of, ())
    prior, fit = prior_of(of, Hypothesis(), shot), found.fit
    at = _evaluated(shot, of.blocks, links_of(()), prior, fit.theta, list(fit.states), of.substeps)
    p, (windows, n) = len(fit.theta), fit.states[0].shape
    spread = np.tile(prior.states, (windows, 1))
    spread[np.asarray(of.blocks[0].first) < 0] = prior.before
    beforehand = np.concatenate([prior.deviation, spread.ravel()])
    whole = np.diag(beforehand**-2)
    for w, gram in enumerate(np.asarray(at.gram)[:, :-1, :-1]):
        own = np.r_[:p, p + n * w : p + n * (w + 1)]
        whole[np.ix_(own, own)] += gram
    unit = whole * np.outer(beforehand, beforehand)
    assert fit.evidence == pytest.approx(-at.cost - 0.5 * np.linalg.slogdet(unit)[1], abs=0.01)


@pytest.mark.parametrize("off", [0.0, 0.01])
def test_a_search_does_not_stop_along_a_valley(off):
    """One input, one sensor: all numbers and the gain may move together, and all but their tolerance is indifferent."""
    u, kinds = drive(), SENSED[:1]
    y, model = 1.04 * exact(u, kinds), chain(kinds)
    level = 1e-5 * y.std(axis=0)
    y = y + level * np.random.default_rng(1).standard_normal(y.shape)
    noise = Noise(level, np.array([[1.0]]), 1e4, "periods")
    three = bench(np.tile(y, (1, 3)), np.tile(level, 3))
    length = window_length(slowest_rate(model), DT, SAMPLES)
    of = three._replace(
        model=model,
        blocks=blocks_of(model, [record(u, y, kinds)], [noise], length),
        moved=(three.moved[0]._replace(y=y),),
        tolerance=np.repeat([0.005, 0.05, 0.005], 3),
    )
    gain = Effect("sensor_gain", (("sensor", "s0"),), {"factor": 1.04 * (1 + off)})
    found = refitted(of, Hypothesis((gain,)), changes=np.full(9, off))
    assert found.fit.settled
    np.testing.assert_allclose(found.fit.theta[:9], 0, atol=1e-3)
    assert float(found.hypothesis.effects[0].parameters["factor"]) == pytest.approx(1.04, rel=1e-3)
