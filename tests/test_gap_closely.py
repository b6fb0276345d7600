"""Windows of a few samples for laws under which neighbouring motions part at once: snaps from well to well."""

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from gap_helpers import DT, JOINT, chain, drive, noisy, record, silent, with_effect
from scipy.linalg import expm
from test_gap_causes import B12, B23, BENCH, candidate, ranking, refit

from jaxsid.gap import search
from jaxsid.gap.closely import (
    LENGTH,
    PARTED,
    begun_along,
    closely,
    implied,
    motions_to_begin,
    parting,
    tightened,
)
from jaxsid.gap.closure import left_of
from jaxsid.gap.examine import examine
from jaxsid.gap.explain import TEMPERATURE
from jaxsid.gap.look import Look
from jaxsid.gap.places import Place
from jaxsid.gap.ranking import LOUD, WORTH
from jaxsid.gap.refit import (
    Hypothesis,
    as_guessed,
    bench_of,
    refitted,
    tied,
    weighed_anew,
)
from jaxsid.gap.roughly import _of_waves, roughly
from jaxsid.gap.search import Found, _followed
from jaxsid.gap.windows import SHORTEST
from jaxsid.mechanics.lumped import Effect, second_order

# its steepest slope is twice the joint's stiffness, so that there are several wells
TRUE = {"amplitude": 12.0, "wavenumber": 250.0, "phase": 0.4}
OFF = {"amplitude": 9.0, "wavenumber": 256.0, "phase": 0.6}
SEEN = 896  # samples of the record


def hypothesis(parameters):
    return Hypothesis((Effect("cogging_ripple", (("between", ("b1", "b2")),), parameters),))


@pytest.fixture(scope="module")
def snaps():
    """A record of snaps, its examination without the last samples, and both benches."""
    u = drive()
    y = noisy(with_effect(u, "cogging_ripple", JOINT, TRUE), 0.01)
    whole, seen = record(u, y), record(u[:SEEN], y[:SEEN])
    found = examine(chain(), seen)
    usual = bench_of(chain(), [seen], found.noises, found.fit)
    return whole, found, usual, closely(chain(), [seen], found.noises, found.fit, found.scored)


@pytest.fixture(scope="module")
def fitted(snaps):
    return refitted(snaps[3], hypothesis(OFF), steps=60)


def test_windows_are_short_and_lead_to_one_another(snaps):
    _, found, _, bench = snaps
    assert all(b.y.shape[1] - b.lead == LENGTH and b.lead > 0 for b in bench.blocks)
    assert np.isfinite(bench.jump)
    assert bench.jump == bench.loose
    # the noise is white, as loud as it was with its colour
    assert all(n.taps.shape[1] == 1 for n in bench.noises)
    np.testing.assert_allclose(bench.noises[0].level, found.noises[0].rms())
    # from the motion that a force at the most probable place implies
    (motion,) = implied(found.scored)
    for block, states in zip(bench.blocks, bench.states, strict=True):
        first = np.asarray(block.first)
        there = (first >= 0) & (first < SEEN)
        np.testing.assert_array_equal(states[there], motion[first[there]])


@pytest.mark.slow
def test_a_law_with_several_wells_is_found_where_usual_windows_are_too_long(snaps, fitted):
    _, _, usual, bench = snaps
    (effect,) = fitted.hypothesis.effects
    for name, value in TRUE.items():
        np.testing.assert_allclose(effect.parameters[name], value, rtol=0.03)
    assert fitted.fit.squares < 1.2 * fitted.fit.equations
    long = refitted(usual, hypothesis(OFF), steps=60)
    assert long.fit.squares > 20 * long.fit.equations
    assert parting(bench, fitted) > PARTED
    assert parting(bench, refitted(bench, Hypothesis(), steps=5)) < PARTED / 2


def test_how_far_linear_motions_part_has_a_closed_form(snaps):
    _, _, usual, bench = snaps
    for of in (bench, usual):
        found = refitted(of, Hypothesis(), steps=3)
        unit = of.state_deviations(())[:6]
        plain = second_order(found.model)
        M, D, K = (np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness))
        A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
        block = of.blocks[0]
        judged = block.y.shape[1] - block.lead
        # a window runs from its lead on to where the next one begins
        ends = judged * np.arange(1, max(SHORTEST // judged, 1) + 1)
        paths = [expm(A * DT * samples) * unit / unit[:, None] for samples in ends]
        most = max(math.log(np.linalg.norm(path, 2)) for path in paths)
        np.testing.assert_allclose(parting(of, found), max(most, 0.0), atol=1e-6)


def test_what_is_guessed_of_the_noise_stays(snaps, fitted):
    bench = snaps[3]
    assert weighed_anew(bench, fitted) is bench
    assert tied(bench, fitted, steps=5) == (bench, fitted)
    assert as_guessed(bench._replace(jump=0.0)).jump == bench.loose


def test_play_goes_where_the_law_is_right(snaps, fitted):
    _, _, usual, bench = snaps
    tight, found = tightened(bench, fitted)
    assert tight.jump < bench.jump / 10
    assert found.fit.evidence > fitted.fit.evidence
    assert as_guessed(tight).jump == bench.loose
    wrong = refitted(bench, Hypothesis(), steps=10)
    assert tightened(bench, wrong) == (bench, wrong)
    plain = refitted(usual, Hypothesis(), steps=3)
    assert tightened(usual, plain) == (usual, plain)


@pytest.mark.slow
def test_held_out_samples_are_followed_as_closely(snaps, fitted):
    whole, found, usual, bench = snaps
    assert motions_to_begin(usual, [whole], found.noises, found.scored) is None
    motions = motions_to_begin(bench, [whole], found.noises, found.scored)
    left = {}
    for name, of in (("law", fitted), ("linear", refitted(bench, Hypothesis(), steps=10))):
        (rest,) = left_of(of, bench, [whole], [SEEN], windowed=True, motions=motions).left
        assert rest.shape == (len(whole.y) - SEEN, 3)
        left[name] = np.sqrt((rest**2).mean(axis=0)) / bench.noises[0].level
    assert (left["law"] < 2).all()
    assert (left["linear"] > 5 * left["law"]).all()


def test_usual_windows_begin_on_the_motion_that_short_ones_follow(snaps, fitted):
    _, _, usual, bench = snaps
    rates = 2 * np.pi / (DT * np.array([80.0, 60.0, 40.0]))

    def motion(first):
        phase = np.multiply.outer(DT * np.asarray(first), rates)
        return np.concatenate([np.sin(phase), rates * np.cos(phase)], axis=1)

    own = np.ones((len(bench.blocks[0].first), 2))
    states = tuple(np.concatenate([motion(b.first), own], axis=1) for b in bench.blocks)
    begun = begun_along(usual, bench, fitted._replace(fit=fitted.fit._replace(states=states)))
    unit = np.concatenate([np.ones(3), rates])
    for block, found in zip(begun.blocks, begun.states, strict=True):
        first = np.asarray(block.first)
        there = (first >= 0) & (first < SEEN)
        assert there.any()
        np.testing.assert_allclose(found[there] / unit, motion(first[there]) / unit, atol=5e-3)
        np.testing.assert_array_equal(found[first < 0], 0.0)


def of_one(kind):
    return refit(0.0, hypothesis=Hypothesis((Effect(kind, tuple(B12.items()), {}),)))


DOWN = refit(0.0).fit._replace(states=(np.full((1, 6), 7.0),))  # of a fit at its very bottom


def followed(monkeypatch, rounds, parts, place=B12, tried=(), kind="cogging_ripple", clear=(True, True)):
    """What comes of rounds: of each, how many laws are taken, what the best leaves, its evidence, a clear look."""
    look = Look(cast(Any, "fit"), cast(Any, "null"), cast(Any, "scored"))
    origin = Found(BENCH, look, (), (), None)
    law = ranking(0.0, kinds=[(kind, B12)])
    law = law._replace(ranked=(law.ranked[0]._replace(refit=of_one(kind)),))
    ends, begun = [], []
    for (selected, left, evidence), nothing in zip(rounds, clear, strict=False):
        last = law._replace(ranked=(law.ranked[0]._replace(left=left, evidence=evidence),))
        found = look._replace(null=cast(Any, SimpleNamespace(p_value=float(nothing), share=1.0)))
        end = origin._replace(look=found, rounds=(last,), selected=last.ranked[:selected])
        ends.append(end._replace(before=refit(0.0)))

    def further(begin, here, *_):
        begun.append((begin, tuple(here)))
        return ends[len(begun) - 1]

    monkeypatch.setattr(search, "at_likeliest", lambda look, candidates: tuple(candidates))
    monkeypatch.setattr(search, "likeliest", lambda scored: Place(*next(iter(place.items()))))
    monkeypatch.setattr(search, "closely", lambda *_: BENCH._replace(loose=0.1))
    monkeypatch.setattr(search, "begun_along", lambda bench, of, found: bench._replace(jump=0.2))
    monkeypatch.setattr(search, "again", lambda law, refit: candidate("cogging_ripple", B23))
    monkeypatch.setattr(search, "changes_of", lambda found, bench: np.arange(9.0))
    monkeypatch.setattr(search, "bench_of", lambda *_, length: BENCH._replace(substeps=length))
    monkeypatch.setattr(search, "refitted", lambda bench, *_, **__: refit(0.0)._replace(fit=DOWN))
    monkeypatch.setattr(search, "_further", further)
    monkeypatch.setattr(search, "parting", lambda bench, found: PARTED + (1.0 if parts else -1.0))
    candidates = [candidate("cogging_ripple", B12)] * 9
    best = ranking(0.0, kinds=[("end_stop", B12)])
    before = origin._replace(rounds=(best,), selected=tried)
    return origin, ends, begun, _followed(before, origin, candidates, BENCH.model, (), silent)


FAR = 2 * WORTH * TEMPERATURE


@pytest.mark.parametrize(("selected", "left", "taken"), [(1, 1.5, True), (0, 1.5, False)])
def test_it_is_taken_where_neighbours_part(monkeypatch, selected, left, taken):
    origin, ends, begun, found = followed(monkeypatch, [(selected, left, 0.0)], True)
    (begin, here) = begun[0]
    assert len(begun) == 1
    assert len(here) == search.CLOSELY
    assert begin == origin._replace(bench=BENCH._replace(loose=0.1))
    assert found == ((ends[0], begin) if taken else None)


@pytest.mark.parametrize(
    ("selected", "clear", "taken"),
    [
        (1, True, 1),
        (1, False, 0),  # something is left there, too
        (0, True, 0),
    ],
)
def test_longer_windows_along_those_tell_what_play_forgives(monkeypatch, selected, clear, taken):
    rounds = [(1, 1.5, 0.0), (selected, 1.5, 0.0)]
    origin, ends, begun, found = followed(monkeypatch, rounds, True, clear=(False, clear))
    begin, tried = begun[1]
    # from where the law of windows of a few samples leads to in them
    assert begin == origin._replace(bench=BENCH._replace(substeps=SHORTEST, jump=0.2, states=DOWN.states))
    assert tried[0].place == B23
    np.testing.assert_array_equal(tried[0].changes, np.arange(9.0))
    assert tried[1:] == begun[0][1]
    assert found == (ends[taken], begun[taken][0])


@pytest.mark.parametrize(
    ("first", "second", "taken"),
    [
        ((1, 1.5), (1, 1.5, 0.0), 1),
        ((1, 1.5), (1, 2.5, 0.0), None),  # too much is left
        (
            (1, 1.5),
            (1, 2.5, FAR),
            1,
        ),  # but far less than by what was tried before: another effect is still to be found
        ((1, 2.5), (1, 2.5, FAR), 1),
        ((1, 2.5), (1, 2.5, 0.0), None),
        ((1, 1.5), (0, 1.5, 0.0), None),  # nothing is worth it
        ((1, 1.5), (0, 2.5, -math.inf), 0),  # no motion under that law follows the records for so long
        ((1, 2.5), (0, 2.5, -math.inf), None),
    ],
)
def test_where_they_hardly_part_its_law_is_tried_in_usual_windows(monkeypatch, first, second, taken):
    # nor is what leaves much in windows of a few samples taken as it is
    origin, ends, begun, found = followed(monkeypatch, [(*first, 0.0), second], first[1] > LOUD)
    begin, tried = begun[1]
    assert begin == origin._replace(bench=BENCH._replace(jump=0.2))
    assert tried[0].place == B23
    np.testing.assert_array_equal(tried[0].changes, np.arange(9.0))
    assert len(tried) == 10
    assert found == (None if taken is None else (ends[taken], begun[taken][0]))


def test_neighbours_that_part_under_a_linear_law_tell_nothing_of_it(monkeypatch):
    _, ends, begun, found = followed(
        monkeypatch, [(1, 1.5, 0.0), (1, 1.5, 0.0)], True, kind="missing_connection"
    )
    assert found == (ends[1], begun[1][0])


def test_a_law_that_was_taken_before_and_leaves_as_much_is_not_tried_again(monkeypatch):
    same = ranking(0.0, kinds=[("cogging_ripple", B12)]).ranked
    _, _, begun, found = followed(monkeypatch, [(1, 2.5, 0.0), (1, 2.5, FAR)], False, tried=same)
    assert found is None
    assert len(begun) == 1


def test_what_acts_between_no_bodies_is_not_followed(monkeypatch):
    assert followed(monkeypatch, [], True, {"input": ("drive",)})[3] is None


# as a motion that drifts shows it: too short, turned round and too small
DRIFTED = {"amplitude": 2.0, "wavenumber": 400.0, "phase": 3.5}


@pytest.mark.slow
def test_a_wave_that_is_far_off_is_found_by_its_other_lengths(snaps):
    *_, close = snaps
    c = candidate("cogging_ripple", B12, **DRIFTED)
    without = refitted(close, Hypothesis())
    ((_, found),) = roughly(close, [(c, hypothesis(DRIFTED), None)], without, 1, silent)
    (effect,) = found.hypothesis.effects
    for name, value in TRUE.items():
        assert effect.parameters[name] == pytest.approx(value, rel=0.05)
    # which the search from what was screened does not come to
    lost = refitted(close, hypothesis(DRIFTED), steps=40)
    assert lost.fit.evidence < found.fit.evidence - 100


def test_only_a_wave_along_the_way_has_other_lengths():
    every = _of_waves(hypothesis(DRIFTED), candidate("cogging_ripple", B12, **DRIFTED))
    lengths = {float(h.effects[-1].parameters["wavenumber"]) for h in every}
    assert len(lengths) == len(every) / 2
    assert min(lengths) < TRUE["wavenumber"] < max(lengths)
    hum = {"amplitude": 1.0, "frequency_hz": 3.0, "phase": 0.0}
    of = Hypothesis((Effect("periodic_disturbance", (("body", "b1"),), hum),))
    assert _of_waves(of, candidate("periodic_disturbance", {"body": "b1"}, **hum)) == []
    spring = Hypothesis((Effect("cubic_stiffness", tuple(B12.items()), {"coefficient": 1e4}),))
    assert _of_waves(spring, candidate("cubic_stiffness", B12, coefficient=1e4)) == []
    # of what was found before nothing is changed
    assert _of_waves(hypothesis(TRUE), candidate("cogging_ripple", B23, **DRIFTED)) == []
    assert _of_waves(Hypothesis(), candidate("cogging_ripple", B12, **DRIFTED)) == []
