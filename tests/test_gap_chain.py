"""Windows that lead to one another: elimination against dense algebra, tied windows against one long simulation."""

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import JOINT, SAMPLES, drive, exact
from gap_helpers import with_effect as truth

from jaxsid.gap.chain import Chain, Links
from jaxsid.gap.fit import _evaluated, _led, _normal, links_of
from jaxsid.gap.refit import Hypothesis, changes_of, prior_of, refitted, shot_of, tied
from jaxsid.gap.setting import LARGE
from jaxsid.mechanics.lumped import Effect

CUBIC = Effect("cubic_stiffness", (("between", ("b1", "b2")),), {"coefficient": 4e5})


def random_chain(links, windows=5, n=3, seed=0):
    """A chain whose matrix is positive, its states of very different size, and that matrix."""
    rng = np.random.default_rng(seed)
    before, after = (np.array(x, int) for x in zip(*links, strict=True)) if links else (np.zeros(0, int),) * 2
    whole = np.zeros((windows * n, windows * n))
    part = lambda i: slice(i * n, (i + 1) * n)  # noqa: E731
    rows = rng.standard_normal((windows, 20, n))
    for w in range(windows):
        whole[part(w), part(w)] += rows[w].T @ rows[w]
    for i, j in zip(before, after, strict=True):
        jump = np.concatenate([rng.standard_normal((n, n)), -np.eye(n)], axis=1) * 5
        both = np.r_[part(i), part(j)]
        whole[np.ix_(both, both)] += jump.T @ jump
    size = np.tile(10.0 ** np.arange(0, -3 * n, -3), windows)
    whole = whole / size / size[:, None]
    inner = np.stack([whole[part(w), part(w)] for w in range(windows)])
    ahead = np.array([whole[part(i), part(j)] for i, j in zip(before, after, strict=True)]).reshape(-1, n, n)
    return Chain(inner, ahead, Links(before, after)), whole


@pytest.mark.parametrize(
    "links",
    [[], [(0, 1), (1, 2), (2, 3), (3, 4)], [(0, 1), (3, 4)], [(3, 4), (2, 3), (0, 1)]],
    ids=["apart", "one chain", "two chains", "any order"],
)
def test_elimination_is_dense_algebra(links):
    chain, whole = random_chain(links)
    right = np.random.default_rng(1).standard_normal((5, 3, 4))
    found, determinant = chain.solved(right)
    expected = np.linalg.solve(whole, right.reshape(15, 4)).reshape(5, 3, 4)
    size = np.abs(expected).max(axis=(0, 2))[:, None]
    np.testing.assert_allclose(found / size, expected / size, atol=1e-7)
    assert determinant == pytest.approx(np.linalg.slogdet(whole)[1], abs=1e-8)


@pytest.fixture(scope="module")
def records():
    return bench(*colored(truth(drive(), "cubic_stiffness", JOINT, {"coefficient": 1e6}), 2))


@pytest.fixture(scope="module")
def apart(records):
    return refitted(records, Hypothesis((CUBIC,)))


def test_each_window_leads_to_the_next(records):
    before, after = links_of(records.blocks)
    (block,) = records.blocks
    length = block.y.shape[1] - block.lead
    first = np.asarray(block.first)
    np.testing.assert_array_equal(first[after], first[before] + length)
    judged = (np.asarray(block.weight)[:, block.lead :] > 0).any(axis=(1, 2))
    assert len(before) == judged.sum() - 1 > 1


def test_derivatives_are_those_of_finite_differences(records, apart):
    chained = records._replace(jump=1e-2)
    hypothesis, shot = apart.hypothesis, shot_of(chained, apart.hypothesis.effects)
    prior, links = prior_of(chained, hypothesis, shot), links_of(chained.blocks)
    rng = np.random.default_rng(0)
    free = prior.deviation > 1e-6
    theta = apart.fit.theta + 1e-4 * free * rng.standard_normal(len(free))
    states = apart.fit.states[0] + 1e-6 * prior.states * rng.standard_normal(apart.fit.states[0].shape)

    def cost(theta, states):
        return _evaluated(shot, chained.blocks, links, prior, theta, [states], chained.substeps)

    here = cost(theta, states)
    normal, rounding = _normal(here, prior, links), 16 * np.finfo(float).eps * here.cost
    for i in (0, 4, 9):
        step = 1e-5 * np.eye(len(theta))[i]
        change = cost(theta + step, states).cost - cost(theta - step, states).cost
        assert 2e-5 * normal.slope[i] == pytest.approx(change, rel=1e-4, abs=rounding)
    for w, i in ((0, 0), (1, 4), (2, 2)):
        step = np.zeros_like(states)
        step[w, i] = 1e-7 * prior.states[i]
        change = cost(theta, states + step).cost - cost(theta, states - step).cost
        assert 2 * step[w, i] * normal.slopes[w, i] == pytest.approx(change, rel=1e-4, abs=rounding)
        assert abs(change) > 100 * rounding


def test_tied_windows_end_where_the_next_begin(records, apart):
    chained, found = tied(records, apart, steps=25)
    assert np.isfinite(chained.jump)
    assert found.fit.evidence > apart.fit.evidence
    shot = shot_of(chained, found.hypothesis.effects)
    links = links_of(chained.blocks)
    prior = prior_of(chained, found.hypothesis, shot)
    at = _evaluated(
        shot, chained.blocks, links, prior, found.fit.theta, list(found.fit.states), chained.substeps
    )
    jumps = found.fit.states[0][links.after] - at.ends[links.before, :, 0]
    assert (np.abs(jumps) < 6 * prior.jump).all()
    (coefficient,) = (float(e.parameters["coefficient"]) for e in found.hypothesis.effects)
    assert abs(coefficient - 1e6) < 4 * found.deviations[0]["coefficient"]
    # the states of many windows cost less, and what they leave is no more than noise
    assert found.deviations[0]["coefficient"] <= apart.deviations[0]["coefficient"]
    assert found.fit.squares < 1.1 * found.fit.equations


@pytest.mark.parametrize(
    ("kind", "where", "place"),
    [("actuator_lag", ("input", "drive"), 0), ("sensor_lag", ("sensor", "s1"), 1)],
)
def test_a_lagging_signal_is_carried_from_window_to_window_in_its_own_unit(kind, where, place):
    """Newtons are no metres: held to what bodies move by, the lag's state would tear the chain."""
    of = bench(*colored(truth(drive(), kind, place, {"time_constant": 0.02}), 3))
    near = refitted(of, Hypothesis((Effect(kind, (where,), {"time_constant": 0.015}),)))
    chained, found = tied(of, near, steps=25)
    assert np.isfinite(chained.jump)
    assert found.fit.evidence > near.fit.evidence + 50
    (value,) = (float(e.parameters["time_constant"]) for e in found.hypothesis.effects)
    assert abs(value - 0.02) < 4 * found.deviations[0]["time_constant"]
    assert found.fit.squares < 1.1 * found.fit.equations
    signal = {"input": of.moved[0].u[:, 0], "sensor": of.moved[0].y[:, 1]}[where[0]]
    rms = np.sqrt((np.asarray(signal) ** 2).mean())
    np.testing.assert_allclose(of.state_deviations(found.hypothesis.effects)[6:], LARGE * rms)


def test_what_was_before_a_record_is_no_larger_than_what_follows():
    """Of what dies out before the first sample noise tells, times what is left of it there; the rest would ring."""
    of = bench(*colored(truth(drive(), "actuator_lag", 0, {"time_constant": 0.05}), 3))
    near = refitted(of, Hypothesis((Effect("actuator_lag", (("input", "drive"),), {"time_constant": 0.04}),)))
    assert int(of.blocks[0].first[0]) < 0
    for found in (near, tied(of, near, steps=25)[1]):
        usual = of.state_deviations(found.hypothesis.effects) / LARGE
        assert (np.abs(found.fit.states[0][0]) < 3 * usual).all()


def test_windows_stay_apart_where_the_model_is_wrong(records):
    linear = refitted(records, Hypothesis())
    chained, found = tied(records, linear, steps=25)
    assert found is linear
    assert chained is records


@pytest.fixture(scope="module")
def straight():
    """Records of the chain itself, and a bench whose windows lead to one another."""
    of = bench(*colored(exact(drive()), 1), wide=True)
    return tied(of, refitted(of, Hypothesis()), steps=25)


def test_states_alone_follow_at_once_where_all_is_linear(straight):
    chained, found = straight
    shot = shot_of(chained, ())
    links, prior = links_of(chained.blocks), prior_of(chained, Hypothesis(), shot)
    at = lambda states: _evaluated(shot, chained.blocks, links, prior, theta, states, chained.substeps)  # noqa: E731
    theta = found.fit.theta * 1.5
    before = at(list(found.fit.states))
    (moves,) = _led(before, prior, links)
    after = at([found.fit.states[0] + moves])
    assert after.cost < before.cost
    # downhill there is nowhere left to go
    slopes = [np.abs(_normal(x, prior, links).slopes * prior.states).max() for x in (before, after)]
    assert slopes[1] < 1e-6 * slopes[0]


def test_a_tied_fit_from_far_off_takes_few_steps():
    """Ties are stiff: without states that follow by themselves the same search takes 22 steps."""
    u = drive(4 * SAMPLES)
    of = bench(*colored(exact(u), 1), u=u)._replace(tolerance=np.full(9, 0.05))
    chained, near = tied(of, refitted(of, Hypothesis()), steps=25)
    begin = 0.15 * np.array([1, -1, 1, -1, 1, 1, -1, 1, -1])
    far = refitted(chained, Hypothesis(), changes=begin, states=near.fit.states, steps=60)
    assert far.fit.settled
    assert far.fit.steps < 20
    assert far.fit.evidence == pytest.approx(near.fit.evidence, abs=0.1)
    np.testing.assert_allclose(far.fit.theta, near.fit.theta, atol=1e-3)


def test_states_that_lead_nowhere_are_made_to_lead_to_one_another_at_once():
    """Windows that stood alone hardly tell of hidden states; a search from jumps between them wanders off."""
    u = drive(4 * SAMPLES)
    of = bench(*colored(exact(u), 1), u=u)
    chained, near = tied(of, refitted(of, Hypothesis()), steps=25)
    rng = np.random.default_rng(2)
    astray = [s + 10 * s.std(axis=0) * rng.standard_normal(s.shape) for s in near.fit.states]
    start = {"changes": changes_of(near, chained), "states": astray}
    found = refitted(chained, Hypothesis(), **start, steps=1)
    assert found.fit.steps == 1
    assert found.fit.evidence == pytest.approx(near.fit.evidence, abs=0.1)


def test_where_states_do_all_that_a_parameter_does_no_more_is_known_than_beforehand():
    """Wells of a ripple that are 0.6 um apart: within a window the motion tells nothing apart from how it began."""
    of = bench(*colored(exact(drive()), 2))
    ripple = {"amplitude": 1.0, "wavenumber": 1e7, "phase": 0.0}
    found = refitted(of, Hypothesis((Effect("cogging_ripple", CUBIC.place, ripple),)), steps=1)
    beforehand = prior_of(of, found.hypothesis, found.shot).deviation
    np.testing.assert_array_equal(np.diag(found.fit.covariance), beforehand**2)
    assert found.deviations[0]["phase"] > 1  # rad
