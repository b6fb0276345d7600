"""Which candidates of a round are fitted, and what follows where nothing more explains what an effect leaves."""

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import chain, drive, exact, silent
from test_gap_causes import B12, B23, BENCH, candidate, ranking, refit

from jaxsid.gap import explain, search
from jaxsid.gap import look as look_of
from jaxsid.gap import ranking as ranking_of
from jaxsid.gap import roughly as roughly_of
from jaxsid.gap.explain import TEMPERATURE, _connections, extended
from jaxsid.gap.look import Look
from jaxsid.gap.places import Place
from jaxsid.gap.ranking import (
    FEWER,
    NEAR,
    STRAIGHT,
    Whole,
    key_of,
    ranked,
    still_due,
)
from jaxsid.gap.refit import Hypothesis, in_windows, refitted
from jaxsid.gap.roughly import ALIKE, HERE, NEARLY, SIZES, loudest, roughly
from jaxsid.gap.search import Found, _otherwise
from jaxsid.gap.windows import BLOCKS
from jaxsid.mechanics.lumped import Effect

B13 = {"between": ("b1", "b3")}
LAWS = ["backlash", "end_stop", "hysteresis", "cubic_stiffness", "quadratic_damping", "quadratic_stiffness"]
LAWS += ["bilinear_stiffness", "time_varying_stiffness"]


@pytest.fixture
def tried(monkeypatch):
    """Kinds and places in the order in which they were fitted, with evidence as told; `senseless` ones make none."""

    def run(candidates, evidences, first, senseless=()):
        fitted = []

        def fit(part, hypothesis, **_):
            if not hypothesis.effects:
                return refit(-1e7, squares=1e9)
            effect = hypothesis.effects[-1]
            key = effect.kind, effect.place[0][1]
            if key not in fitted:
                fitted.append(key)
            return refit(evidences.get(key, -1e6), hypothesis=hypothesis)

        monkeypatch.setattr(roughly_of, "refitted", fit)
        monkeypatch.setattr(roughly_of, "changes_of", lambda found, bench: None)
        monkeypatch.setattr(roughly_of, "side_by_side", lambda f, xs: [f(x) for x in xs])
        monkeypatch.setattr(
            ranking_of, "sensible", lambda found, bench: found.hypothesis.effects[-1].kind not in senseless
        )
        every = [(c, extended(Hypothesis(), c, {}), None) for c in candidates]
        return fitted, roughly(BENCH, every, refit(-1e7), first, silent)

    return run


def test_further_laws_are_tried_where_the_best_one_acts(tried):
    candidates = [candidate("backlash", B23), candidate("stribeck_friction", B12)]
    candidates += [candidate(k, p) for k in LAWS[1:] for p in (B12, B13, B23)]
    candidates += [candidate("coulomb_friction", B12)]
    evidences = {("stribeck_friction", ("b1", "b2")): -10.0, ("backlash", ("b2", "b3")): -50.0}
    fitted, rough = tried(candidates, evidences, 2)
    here = [(k, ("b1", "b2")) for k in LAWS[1 : 1 + HERE]]
    assert fitted == [("backlash", ("b2", "b3")), ("stribeck_friction", ("b1", "b2")), *here]
    assert rough[0][0].kind == "stribeck_friction"


def test_a_law_that_leaves_more_than_there_was_begins_anew_with_another_number(monkeypatch):
    """From far off the search stays where it began."""
    valley, started = 0.25, []

    def fit(part, hypothesis, *, steps, **_):
        if not hypothesis.effects:
            return refit(-1.0, squares=1000.0)
        (size,) = hypothesis.effects[-1].parameters.values()
        started.append((float(size), steps))
        squares = 900.0 if steps > 1 and size == valley else 1000.0 + abs(float(np.log(size / valley)))
        return refit(-squares, squares, hypothesis=hypothesis)

    for name, instead in {
        "refitted": fit,
        "changes_of": lambda found, bench: None,
        "side_by_side": lambda f, xs: [f(x) for x in xs],
        "value": lambda found, bench: found.fit.evidence,
    }.items():
        monkeypatch.setattr(roughly_of, name, instead)

    def found(**parameters):
        started.clear()
        c = candidate("actuator_lag", {"input": "u"}, **parameters)
        ((_, best),) = roughly(BENCH, [(c, extended(Hypothesis(), c, {}), None)], refit(-1.0), 1, silent)
        return best.fit.squares

    assert found(time_constant=1.0) == 900.0
    assert [x for x, steps in started if steps == 1] == [k * 1.0 for k in SIZES]
    assert found(time_constant=0.25) == 900.0  # it need not
    assert len([x for x, steps in started if steps == 1]) == 0


def test_of_blocks_that_are_missed_as_much_the_one_of_the_largest_signal_counts():
    half = BLOCKS[-1]
    u = drive(2 * half)
    u[half:] *= 5.0
    y, level = colored(exact(u), 0)
    y[: half // 2] += 0.4 * level * (-1.0) ** np.arange(half // 2)[:, None]
    of = bench(y, level, u=u)
    assert len(of.blocks) == 2
    found = refitted(of, Hypothesis())
    size = [
        float((np.asarray(x.left) ** 2 * np.asarray(b.weight)).sum())
        for b, x in zip(of.blocks, in_windows(of, found), strict=True)
    ]
    assert ALIKE < size[1] / size[0] < 1.0
    assert loudest(of, found).blocks[0] is of.blocks[1]


def test_springs_are_tried_wherever_a_law_acts(tried):
    candidates = [candidate("end_stop", B13), candidate("backlash", B23)]
    candidates += [candidate(k, B13) for k in LAWS[1 : 1 + HERE]]
    candidates += [candidate(k, B13) for k in ("coulomb_friction", "missing_connection")]
    fitted, _ = tried(candidates, {("end_stop", ("b1", "b3")): -10.0}, 2)
    assert ("missing_connection", ("b1", "b3")) in fitted
    assert ("coulomb_friction", ("b1", "b3")) not in fitted


def test_springs_are_tried_where_the_best_laws_act_beside_the_very_best(tried):
    """A law of a joined place may nearly stand for the spring beside it."""
    places = [{"between": ("b1", f"b{i}")} for i in range(2, 4 + NEARLY)]
    candidates = [candidate("end_stop", p) for p in places]
    candidates += [candidate("missing_connection", p) for p in places]
    evidences = {("end_stop", p["between"]): -10.0 * (i + 1) for i, p in enumerate(places)}
    fitted, _ = tried(candidates, evidences, len(places))
    assert [p for k, p in fitted if k == "missing_connection"] == [p["between"] for p in places[:NEARLY]]


def test_the_order_of_two_ends_does_not_count():
    assert key_of("backlash", {"between": ("b1", "b2")}) == key_of("backlash", {"between": ["b2", "b1"]})
    assert key_of("backlash", {"between": ("b1", "b2")}) != key_of("end_stop", {"between": ("b1", "b2")})
    assert key_of("backlash", {"between": ("b1", "b2")}) != key_of("backlash", {"between": ("b1", "b3")})
    assert key_of("constant_load", {"body": "x"}) != key_of("constant_load", {"sensor": "x"})
    assert len({key_of("sensor_gain", {"sensor": "ab"}), key_of("sensor_gain", {"sensor": "ba"})}) == 2


def test_a_spring_comes_before_a_law_that_hardly_differs_from_it():
    kinds = [("end_stop", B12), ("missing_connection", B12), ("cubic_stiffness", B23)]
    unit = TEMPERATURE  # of evidence, where the best one leaves noise
    first = lambda lead: ranking(0.0, -lead * unit, -unit, kinds=kinds).ranked[0].kind  # noqa: E731
    assert first(STRAIGHT - 0.1) == "missing_connection"
    assert first(STRAIGHT + 0.1) == "end_stop"
    found = ranking(0.0, -unit, kinds=kinds)
    assert found.ranked[0].probability == pytest.approx(1 / (1 + np.exp(1 - STRAIGHT)))
    # what it is worth to have an effect at all is told by evidence alone
    assert found.gain == pytest.approx((-unit + 1e4) / TEMPERATURE)


def test_what_was_fitted_to_a_part_alone_never_comes_first():
    stop, spring = candidate("end_stop", B12), candidate("missing_connection", B23)
    bench = BENCH._replace(blocks=(None, None))
    states = lambda count: (np.zeros((1, 2)),) * count  # noqa: E731

    def first(blocks):
        fits = [refit(0.0), refit(-1.0)]
        fits = [
            x._replace(fit=x.fit._replace(states=states(n))) for x, n in zip(fits, (2, blocks), strict=True)
        ]
        every = [(c, x, x.fit.evidence, 1.0) for c, x in zip((stop, spring), fits, strict=True)]
        return ranked(every, refit(-1e4), bench, TEMPERATURE).ranked[0]

    assert first(2).kind == "missing_connection"
    assert first(1).kind == "end_stop"
    assert len(first(1).refit.fit.states) == 2


def test_springs_are_candidates_where_the_model_joins_nothing():
    laws = [candidate("end_stop", B13), candidate("end_stop", B12), candidate("sensor_lag", {"sensor": "s1"})]
    assert [(c.kind, c.place) for c in _connections(chain(), laws)] == [("missing_connection", B13)]


@pytest.mark.parametrize(
    ("best", "values", "due"),
    [
        ("end_stop", [0.0, -30.0, -10.0], [1]),  # a spring near a stop at its place
        ("end_stop", [0.0, -50.0, -10.0], []),  # far from it
        ("end_stop", [0.0, -50.0, -0.9 * STRAIGHT], [2]),  # one elsewhere, that would come before the stop
        ("missing_connection", [-10.0, 0.0, -10.0], []),  # the spring is the best one
    ],
)
def test_springs_are_fitted_thoroughly_beside_a_law_that_is_not(best, values, due):
    kinds = [("end_stop", B13), ("missing_connection", B13), ("missing_connection", B12)]
    rough = [(candidate(*k), refit(v)) for k, v in zip(kinds, values, strict=True)]
    done = {[k for k, _ in kinds].index(best): Whole(BENCH, refit(0.0))}
    assert still_due(rough, values, done, 40.0) == due
    assert still_due(rough, values, {}, 40.0) == [int(np.argmax(values))]


def test_laws_of_fewer_numbers_are_fitted_thoroughly_where_a_richer_one_is_best():
    near, far = 1000.0 * NEAR**2 * 0.9, 1000.0 * NEAR**2 * 1.1  # squares next to those of the best one
    laws = [
        ("end_stop", B12, 1000.0),
        ("cubic_stiffness", B23, near),
        ("missing_connection", B12, near),
        ("quadratic_stiffness", B12, far),
        ("constant_load", {"body": "b2"}, near),
        ("backlash", B12, near),
        ("cubic_stiffness", {"between": ("b2", "b1")}, near),
        ("bilinear_stiffness", B12, near),
    ]
    assert FEWER == 2
    rough = [(candidate(k, p), refit(-1e6 * i, squares)) for i, (k, p, squares) in enumerate(laws)]
    values, whole = [-1e6 * i for i in range(len(laws))], Whole(BENCH, refit(0.0))
    assert still_due(rough, values, {0: whole}, 40.0) == [5, 6]
    assert still_due(rough, values, {0: whole, 5: whole}, 40.0) == [6]
    assert still_due(rough, values, {0: whole, 5: whole, 6: whole}, 40.0) == []
    # one number has none within it
    assert still_due(rough, [*values[:5], 1.0, *values[6:]], {5: whole}, 40.0) == []


@pytest.mark.parametrize(("body", "due"), [("b2", [1]), ("b3", [])])
def test_a_periodic_force_is_fitted_thoroughly_in_the_place_of_a_part_that_swings(body, due):
    kinds = [("missing_mode", {"body": "b2"}), ("periodic_disturbance", {"body": body})]
    rough = [(candidate(*k), refit(v)) for k, v in zip(kinds, [0.0, -1e4], strict=True)]
    assert still_due(rough, [0.0, -1e4], {0: Whole(BENCH, refit(0.0))}, 40.0) == due
    # a periodic force stands for no part that swings
    assert still_due(rough, [-1e4, 0.0], {1: Whole(BENCH, refit(0.0))}, 40.0) == []


def test_the_simpler_law_is_found_where_the_best_one_makes_no_sense(tried):
    candidates = [candidate("backlash", B23), candidate("stribeck_friction", B12)]
    candidates += [candidate("hysteresis", B13), candidate("coulomb_friction", B12)]
    evidences = {
        ("stribeck_friction", ("b1", "b2")): -10.0,
        ("backlash", ("b2", "b3")): -50.0,
        ("coulomb_friction", ("b1", "b2")): -12.0,
    }
    fitted, rough = tried(candidates, evidences, 2, senseless=("stribeck_friction",))
    assert [c.kind for c, _ in rough] == ["coulomb_friction", "backlash", "stribeck_friction"]
    assert ("hysteresis", ("b1", "b3")) not in fitted


def round_of(monkeypatch, effort, worse, outcome, without, led_away=()):
    """Where a round's thorough fits begin, each far worse than it seemed, the first few diverging; values compared.

    Rough fits of those led away come last.
    """
    begin = [Hypothesis((Effect("cogging_ripple", (), {"amplitude": float(i)}),)) for i in range(30)]
    every = [(candidate("cogging_ripple", {"between": (f"x{i}", "y")}), h, None) for i, h in enumerate(begin)]
    thorough, compared = [], []

    def whole(bench, hypothesis, start, effort):
        thorough.append(hypothesis)
        return Whole(BENCH, refit(-math.inf if len(thorough) <= worse else -1e5 - len(thorough)))

    patches = {
        "loudest": lambda bench, without: bench,
        "alone": lambda part, without: refit(-1e9),
        "roughly": lambda part, every, without, tried, say: sorted(
            ((c, refit(-10.0 * i - 1000.0 * (i in led_away))) for i, (c, *_) in enumerate(every)),
            key=lambda x: -x[1].fit.evidence,
        ),
        "_whole": whole,
        "_values": lambda rough, done, *_: [
            done[i].refit.fit.evidence if i in done else r.fit.evidence for i, (_, r) in enumerate(rough)
        ],
        "side_by_side": lambda f, xs: [f(x) for x in xs],
        "changes_of": lambda found, bench: None,
        "value": lambda found, bench: found.fit.evidence,
        "_compared": lambda rough, values, *_: compared.append(values) or outcome,
    }
    for name, instead in patches.items():
        monkeypatch.setattr(explain, name, instead)
    explain._round(BENCH, every, without, effort, silent)
    return thorough, compared


@pytest.mark.parametrize("diverging", [0, 4])
def test_those_after_many_that_turn_out_worse_are_not_fitted_thoroughly(monkeypatch, diverging):
    thorough, (values,) = round_of(monkeypatch, explain.FURTHER, diverging, ranking(0.0), refit(0.0))
    # what diverges at once costs nothing, and does not count
    assert len(thorough) == explain.FURTHER.refined + explain.MORE + diverging
    assert int(np.argmax(values)) == diverging
    assert values[-1] < values[diverging]


BESIDE = refit(0.0, hypothesis=Hypothesis((Effect("backlash", tuple(B12.items()), {"half_gap": 1.0}),)))
WORTHLESS = ranking(0.0, without=0.0)


@pytest.mark.parametrize(
    ("outcome", "without", "more"),
    [
        (WORTHLESS, refit(0.0), explain.SECOND),
        (ranking(0.0), refit(0.0), 0),  # one is worth it
        (WORTHLESS, BESIDE, 0),  # something was found before
        (
            WORTHLESS._replace(ranked=(WORTHLESS.ranked[0]._replace(left=9.0),)),
            refit(0.0),
            0,
        ),  # loud: no law is right
    ],
)
def test_where_none_is_worth_anything_more_are_fitted_thoroughly(monkeypatch, outcome, without, more):
    thorough, compared = round_of(monkeypatch, explain.FIRST, 0, outcome, without)
    assert len(thorough) == explain.FIRST.refined + explain.MORE + more
    assert len(compared) == 1 + (more > 0)
    # each of them counts for what it is, not for what it seemed
    assert sum(x <= -1e5 for x in compared[-1]) >= len(thorough)


def test_beside_an_effect_those_that_a_part_led_away_begin_as_they_were_screened(monkeypatch):
    thorough, compared = round_of(monkeypatch, explain.FURTHER, 0, WORTHLESS, BESIDE, led_away=(1, 2, 5))
    usual = explain.FURTHER.refined + explain.MORE
    # of the first three that are screened two were not fitted to all, and begin where the screening has them
    assert [h.effects[0].parameters["amplitude"] for h in thorough[usual:]] == [1.0, 2.0]
    assert not any(h.effects for h in thorough[:usual])
    assert len(compared) == 2
    # what is known of all others is less than of the best of them
    best = max(x for x in compared[-1] if x <= -1e5)
    assert max(x for x in compared[-1]) == best
    # not where one is worth it
    assert len(round_of(monkeypatch, explain.FURTHER, 0, ranking(0.0), BESIDE, led_away=(1, 2))[0]) == usual


def test_a_round_without_candidates_has_no_fits(tried):
    assert tried([], {}, 5) == ([], [])


# what is tried next


def test_laws_where_what_is_left_most_probably_arises_are_tried_early(monkeypatch):
    """A colour of the noise that has taken what is left for noise lets forces of one frequency come first anywhere."""
    elsewhere = [candidate(k, B12) for k in LAWS] + [candidate(k, B13) for k in LAWS]
    here = [candidate("stribeck_friction", B23), candidate("missing_mode", {"body": "b2"})]
    first = [candidate("cogging_ripple", B12)]
    monkeypatch.setattr(look_of, "candidates_of", lambda look: (*elsewhere, *here))
    monkeypatch.setattr(look_of, "likeliest", lambda scored: Place("between", B23["between"]))
    look = Look(*map(cast, [Any] * 3, ("fit", "null", "scored")))
    found = look_of.to_try(look, first)
    assert {key_of(c.kind, c.place) for c in found} == {
        key_of(c.kind, c.place) for c in (*elsewhere, *here, *first)
    }
    assert found[:4] == (elsewhere[0], here[0], elsewhere[1], first[0])
    assert look_of.to_try(look._replace(scored=None), first)[:3] == (
        elsewhere[0],
        elsewhere[1],
        first[0],
    )
    monkeypatch.setattr(look_of, "candidates_of", lambda look: ())
    assert look_of.to_try(look, first) == ()


# where nothing more explains what is left


@pytest.fixture
def searched(monkeypatch):
    """An effect with another that is hardly told from it; what is found beside either."""

    def run(
        evidences=(0.0, -TEMPERATURE, -40 * TEMPERATURE),
        clear=False,
        beside=("end_stop",),
        whole=True,
        last=0.0,
    ):
        first = ranking(*evidences)
        bench = BENCH if whole else BENCH._replace(blocks=(SimpleNamespace(),))
        first = first._replace(bench=bench)
        look = SimpleNamespace(clear=clear)
        origin = Found(bench, "begun", (), (), None)
        at = origin._replace(look=look, rounds=(first,), selected=first.ranked[:1], before=refit(0.0))

        def taken(self, of):
            return self._replace(rounds=(of,), selected=(*self.selected, of.ranked[0]), before=refit(last))

        def further(other, candidates, *_):
            kinds = [k for k in beside if other.selected[0].kind == "backlash"]
            more = [ranking(0.0, kinds=[(k, B23)]) for k in kinds]
            return other._replace(
                rounds=(*other.rounds, *more), selected=(*other.selected, *(m.ranked[0] for m in more))
            )

        monkeypatch.setattr(Found, "taken", taken)
        monkeypatch.setattr(search, "looked", lambda *_: look)
        monkeypatch.setattr(search, "to_try", lambda look, first: ())
        monkeypatch.setattr(search, "_further", further)
        return at, _otherwise(at, origin, (), BENCH.model, (), silent)

    return run


def test_what_is_hardly_told_apart_is_tried_where_nothing_more_is_found(searched):
    _, found = searched()
    assert [x.kind for x in found.selected] == ["backlash", "end_stop"]
    # its round stays whole
    assert [x.kind for x in found.rounds[0].ranked] == ["backlash", "cubic_stiffness", "end_stop"]
    np.testing.assert_allclose(sum(x.probability for x in found.rounds[0].ranked), 1.0, rtol=1e-6)


@pytest.mark.parametrize(
    "case",
    [
        {"clear": True},  # nothing is left
        {"evidences": (0.0, -40 * TEMPERATURE)},  # nothing is like it
        {"beside": ()},  # nothing more is found beside the other either
        {"whole": False},  # the other was fitted to a part of the records only
        {"last": -np.inf},  # with the other the motion grows without bound
    ],
)
def test_else_the_first_effect_stays(searched, case):
    at, found = searched(**case)
    assert found is at


# the same law at other places


@pytest.fixture
def moved(monkeypatch):
    """A round that hysteresis at b1 - b2 won; thorough fits elsewhere have the evidence told, in noise as told."""

    def run(evidences, candidates):
        fitted = []
        first = ranking(0.0, -20 * TEMPERATURE, kinds=[("hysteresis", B12), ("hysteresis", B13)])

        def whole(bench, hypothesis, start, effort):
            place = hypothesis.effects[-1].place[0][1]
            fitted.append(place)
            return Whole(BENCH._replace(jump=0.1), refit(evidences[place], hypothesis=hypothesis))

        monkeypatch.setattr(explain, "_whole", whole)
        monkeypatch.setattr(explain, "refitted", lambda bench, hypothesis, **_: refit(-1e4))
        monkeypatch.setattr(explain, "changes_of", lambda found, bench: None)
        for module in (explain, ranking_of):
            monkeypatch.setattr(module, "gauge", lambda bench: 0.0)
            monkeypatch.setattr(module, "volume", lambda bench: 0.0)
        monkeypatch.setattr(explain, "side_by_side", lambda f, xs: [f(x) for x in xs])
        return first, fitted, explain.elsewhere(first, candidates, None, explain.FIRST)

    return run


LOOP = {"stiffness": 1.0, "beta": 1.0, "gamma": 0.0, "exponent": 1.0}
HYSTERESIS = [candidate("hysteresis", p, **LOOP) for p in (B12, B13, B23)]


def test_the_law_is_placed_anew_where_it_explains_more(moved):
    other = candidate("backlash", B23, stiffness=1.0)
    _, fitted, found = moved({("b1", "b3"): 5 * TEMPERATURE, ("b2", "b3"): -9.0}, [other, *HYSTERESIS])
    assert fitted == [("b1", "b3"), ("b2", "b3")]  # neither other laws nor its own place again
    assert [x.place["between"] for x in found.ranked] == [("b1", "b3"), ("b1", "b2"), ("b2", "b3")]
    assert found.bench.jump == 0.1
    assert sum(x.probability for x in found.ranked) == pytest.approx(1.0, abs=1e-6)
    assert found.ranked[0].probability / found.ranked[1].probability == pytest.approx(np.exp(5), rel=1e-6)


def test_the_round_stays_where_the_law_explains_no_more_elsewhere(moved):
    first, fitted, found = moved({("b1", "b3"): -1.0, ("b2", "b3"): -2.0}, HYSTERESIS)
    assert len(fitted) == 2
    assert found is first
    assert moved({}, HYSTERESIS[:1])[2] == first  # nowhere else to go


@pytest.mark.parametrize("last", [0.0, -np.inf])
def test_a_law_elsewhere_is_taken_unless_the_motion_grows_without_bound(monkeypatch, last):
    once, anew, look = ranking(0.0), ranking(1.0), SimpleNamespace(clear=True)
    origin = Found(BENCH, "begun", (), (), None)
    at = origin._replace(look=look, rounds=(once,), selected=once.ranked[:1], before=refit(0.0))
    monkeypatch.setattr(search, "elsewhere", lambda *_: anew)
    monkeypatch.setattr(search, "looked", lambda *_: look)
    monkeypatch.setattr(
        Found, "taken", lambda self, of: self._replace(rounds=(of,), selected=of.ranked, before=refit(last))
    )
    found = search._elsewhere(at, origin, (), BENCH.model, (), silent)
    assert found.rounds[0] is (anew if last == 0.0 else once)


def test_a_part_that_tells_of_no_candidate_leaves_them_as_they_were_screened():
    screened = [candidate(kind, B12) for kind in ("hysteresis", "backlash", "cubic_stiffness")]
    rough = [(screened[i], refit(e)) for i, e in ((2, -5.0), (1, -6.0), (0, -20.0))]
    assert explain._promising(rough, screened, -4.9, BENCH) == [2, 1, 0]
    assert explain._promising(rough, screened, -5.1, BENCH) == [0, 1, 2]
    assert explain._promising([], screened, 0.0, BENCH) == []
