"""What is concluded from fits, without fitting: rankings, sets, verdicts, numbers of a model as effects, offsets."""

import math
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import SAMPLES, chain, drive, exact, noisy, record, silent

from jaxsid import diagnose
from jaxsid.gap import search as module
from jaxsid.gap.causes import _beyond
from jaxsid.gap.explain import (
    TEMPERATURE,
    _distinct,
    _values,
    again,
    elements_by_key,
    extended,
)
from jaxsid.gap.fit import Fit
from jaxsid.gap.noise import FINEST, noise_of, residual_noise
from jaxsid.gap.numbers_off import OFF, numbers_off
from jaxsid.gap.ranking import ERRORS, WORTH, Explanation, Ranking, alike, key_of, numbers_of, ranked, worth
from jaxsid.gap.refit import Bench, Hypothesis, Refit
from jaxsid.gap.screen import Candidate
from jaxsid.gap.search import LEAST, TELLING, Found, _numbers, _reconsidered
from jaxsid.mechanics.lumped import Connection, Effect, Input, Matrices, Sensor, lumped_model, second_order
from jaxsid.physical.elements import element_matrices

B12, B23 = {"between": ("b1", "b2")}, {"between": ("b2", "b3")}


BENCH = Bench(chain(), (), (), (), np.zeros(9), np.zeros(9), np.zeros(6), 1, 2, (), ())  # of no matter here


def refit(evidence, squares=1000.0, equations=1000, hypothesis=None, deviation=0.1):
    nothing = np.zeros(1)
    fit = Fit(nothing, (), squares, equations, np.eye(1), evidence, 5, True)
    of = hypothesis or Hypothesis()
    return Refit(of, fit, None, tuple({"size": deviation} for _ in of.effects), None)


def candidate(kind, place, **parameters):
    return Candidate(kind, place, parameters, np.zeros(9), 0.0, 1.0, "", {})


def ranking(*evidences, without=-1e4, squares=1000.0, kinds=None):
    kinds = kinds or [("cubic_stiffness", B12), ("backlash", B12), ("end_stop", B12), ("hysteresis", B23)]
    every = [
        (candidate(*kinds[i]), refit(e, squares), e, 1.0)
        for i, e in enumerate(evidences)
        if not math.isnan(e)
    ]
    return ranked(every, refit(without), BENCH, TEMPERATURE)


# keys and numbers


def parallel():
    """Two connections side by side between a and b."""
    return lumped_model(
        ["a", "b"],
        [1.0, 2.0],
        [10.0, 20.0, 30.0],
        [0.1, 0.2, 0.3],
        connections=[
            Connection(n, e) for n, e in zip("wxy", [("ground", "a"), *[("a", "b")] * 2], strict=True)
        ],
        inputs=[Input("f", "a")],
        sensors=[Sensor("s", "a", "velocity")],
    )


def matrices():
    parts = (jnp.eye(2) + k * jnp.array([[1.0, -1.0], [-1.0, 1.0]]) for k in (0.0, 0.1, 5.0))
    return lumped_model(
        ["a", "b"],
        matrices=Matrices(*parts),
        inputs=[Input("f", "a")],
        sensors=[Sensor("s", "a", "velocity")],
    )


@pytest.mark.parametrize("model", [chain(), parallel(), matrices()], ids=["chain", "parallel", "matrices"])
def test_every_number_of_a_model_is_the_error_of_one_effect(model):
    found, listed = elements_by_key(model), element_matrices(model).listed
    rows = [i for own in found.values() for i in own]
    assert sorted(rows) == list(range(len(listed)))
    for (kind, where, ends), own in found.items():
        assert {listed[i].quantity for i in own} == {kind.removesuffix("_error")}
        # a mass between two bodies is no mass of a body
        assert (where == "body") == (kind == "mass_error" and len(ends) == 1)
        assert where == "body" or len(ends) == 2


def test_a_wrong_number_is_one_whichever_way_it_is_told():
    assert [numbers_of(kind) for kind in ERRORS.values()] == [1, 1, 1]
    assert numbers_of("missing_connection") == 2
    assert numbers_of("stribeck_friction") == 3


def test_numbers_bear_the_names_of_places():
    found = elements_by_key(chain())
    listed = element_matrices(chain()).listed
    (row,) = found[key_of("stiffness_error", B12)]
    assert (listed[row].element, listed[row].quantity) == ("c2", "stiffness")
    (row,) = found[key_of("damping_error", {"between": ("ground", "b1")})]
    assert (listed[row].element, listed[row].quantity) == ("c1", "damping")
    (row,) = found[key_of("mass_error", {"body": "b3"})]
    assert (listed[row].element, listed[row].quantity) == ("b3", "mass")
    side_by_side = elements_by_key(parallel())[key_of("stiffness_error", {"between": ("b", "a")})]
    assert [element_matrices(parallel()).listed[i].element for i in side_by_side] == ["x", "y"]
    of_matrices = elements_by_key(matrices())
    for key in (
        ("stiffness_error", {"between": ("a", "b")}),
        ("damping_error", {"between": ("ground", "b")}),
    ):
        assert key_of(*key) in of_matrices


def test_hypotheses_grow_by_effects_and_by_wrong_numbers():
    errors = elements_by_key(chain())
    first = extended(Hypothesis(), candidate("cubic_stiffness", B12, coefficient=1e6), errors)
    (effect,) = first.effects
    assert (effect.kind, effect.place, first.wrong) == ("cubic_stiffness", (("between", ("b1", "b2")),), ())
    assert effect.parameters == {"coefficient": 1e6}
    second = extended(first, candidate("stiffness_error", {"between": ("b3", "b2")}, factor=1.2), errors)
    assert second.effects == first.effects
    assert second.wrong == errors[key_of("stiffness_error", B23)]
    third = extended(second, candidate("mass_error", {"body": "b1"}, factor=1.2), errors)
    assert third.wrong == tuple(sorted((*second.wrong, *errors[key_of("mass_error", {"body": "b1"})])))
    # where the model has no connection an error of its stiffness is an effect
    new = extended(Hypothesis(), candidate("stiffness_error", {"between": ("b1", "b3")}, factor=1.2), errors)
    assert len(new.effects) == 1
    again = [
        candidate("cubic_stiffness", {"between": ("b2", "b1")}),
        candidate("stiffness_error", B23),
        candidate("cubic_stiffness", B23),
        candidate("mass_error", {"body": "b2"}),
    ]
    assert _distinct(again, third, errors) == again[2:]


# rankings


def test_probabilities_are_tempered_evidences():
    found = ranking(-40.0, 10.0, -2e3, without=-5e3, squares=2000.0)
    assert [x.kind for x in found.ranked] == ["backlash", "cubic_stiffness", "end_stop"]
    assert found.scale == 2.0
    ratio = found.ranked[1].probability / found.ranked[0].probability
    assert ratio == pytest.approx(math.exp(-50 / (2 * TEMPERATURE)))
    assert sum(x.probability for x in found.ranked) == pytest.approx(1)


def test_no_effect_at_all_is_an_alternative_too():
    found = ranking(0.0, without=0.0)
    assert found.ranked[0].probability == pytest.approx(0.5)
    none = ranked([], refit(0.0), BENCH, TEMPERATURE)
    assert (none.ranked, none.gain) == ((), 0.0)
    assert _values([], {}, BENCH, BENCH) == []


@pytest.mark.parametrize("without", [-1e4, -np.inf])
def test_candidates_under_which_the_motion_grows_without_bound_are_worth_nothing(without):
    with np.errstate(invalid="raise", divide="raise"):
        lost = ranking(-np.inf, -np.inf, without=without, squares=np.inf)
        assert lost.gain == 0.0
        assert sum(x.probability for x in lost.ranked) <= 1
        assert math.isfinite(lost.scale)
        one = ranking(-np.inf, -500.0, without=without)
    assert [x.kind for x in one.ranked] == ["backlash", "cubic_stiffness"]
    assert one.ranked[0].probability == pytest.approx(1.0)
    assert one.gain > WORTH


def test_alike_are_those_that_tempered_evidence_hardly_tells_apart():
    found = ranking(0.0, -2.9 * TEMPERATURE, -3.1 * TEMPERATURE)
    first, second, third = found.ranked
    assert alike(first, second, found)
    assert not alike(first, third, found)


def test_a_further_effect_must_be_worth_it():
    def enough(gain, before, equations=1000, least=LEAST):
        best, without = refit(gain, equations, equations), refit(0.0, before, equations)
        one = Explanation("backlash", B12, best, gain, 1.0, 1.0)
        return worth(Ranking((one,), without, 1.0, TEMPERATURE, BENCH), least)

    assert enough(1.01 * WORTH * TEMPERATURE, 1500.0)
    assert not enough(0.99 * WORTH * TEMPERATURE, 1500.0)
    assert enough(101.0, 3000.0)
    assert not enough(99.0, 3000.0)  # of the 2000 above the noise less than a tenth
    assert enough(51.0, 1e4, equations=10000)
    assert not enough(49.0, 1e4, equations=10000)  # there is nothing but noise, of which less than 1 %
    assert enough(49.0, 1e4, equations=10000, least=0.009)
    assert _beyond(refit(1.01 * WORTH), refit(0.0), 1.0)
    assert not _beyond(refit(1.01 * WORTH), refit(0.0), 1.1)


def test_a_refused_effect_leaves_what_was_found_as_it_is():
    first, second = ranking(0.0), ranking(1.0)
    other = second._replace(bench=BENCH._replace(substeps=7))
    begun = Found(BENCH, None, (), (), None)
    assert begun.refused(other) == begun._replace(bench=other.bench, rounds=(other,))
    found = begun._replace(rounds=(first,), selected=first.ranked[:1])
    assert found.refused(other) is found


def test_numbers_beyond_their_tolerance_are_candidates_farthest_first():
    model = chain()
    count = len(element_matrices(model).listed)
    tolerance = np.full(count, 0.01)
    bench = BENCH._replace(model=model, tolerance=tolerance)
    theta = np.zeros(count + 4)
    stiff, heavy = elements_by_key(model)[key_of("stiffness_error", B12)][0], 1
    theta[stiff], theta[heavy], theta[0] = -0.03, 0.05, 0.9 * OFF * 0.01
    found = refit(0.0)._replace(fit=refit(0.0).fit._replace(theta=theta))
    candidates = numbers_off(bench, found)
    named = [key_of(c.kind, c.place) for c in candidates if c.kind in ERRORS.values()]
    assert named == [key_of("mass_error", {"body": "b2"}), key_of("stiffness_error", B12)]
    # gains can stand for numbers
    assert [c.kind for c in candidates] == [
        "mass_error",
        "input_gain",
        "stiffness_error",
        *["sensor_gain"] * 3,
    ]
    known = found._replace(hypothesis=Hypothesis(wrong=(heavy,)))
    again = [c.kind for c in numbers_off(bench, known) if c.kind in ERRORS.values()]
    assert again == ["stiffness_error"]
    still = found._replace(fit=found.fit._replace(theta=0 * theta))
    assert numbers_off(bench, still) == ()
    # what is nothing nominally has no factor, however far it seems to be off
    nominal = np.array(model.stiffness)
    nominal[1] = 0.0
    free = bench._replace(model=eqx.tree_at(lambda m: m.stiffness, model, jnp.asarray(nominal)))
    gone = [c.kind for c in numbers_off(free, found)]
    assert "stiffness_error" not in gone
    assert "mass_error" in gone


@pytest.mark.parametrize(("scored", "named"), [(None, 1), ("places", 0)])
def test_where_numbers_alone_are_in_doubt_the_one_that_explains_most_is_named(monkeypatch, scored, named):
    """Tests have said that some number is off; beside a law that is missing they have not."""
    little = ranking(-1.0, without=-1.0 - 0.5 * TELLING * TEMPERATURE, kinds=[("stiffness_error", B12)])
    assert 0 < little.gain < TELLING
    offs = [(candidate("stiffness_error", B12),), ()]
    monkeypatch.setattr(module, "numbers_off", lambda *_: offs.pop(0))
    monkeypatch.setattr(module, "hint", lambda *_: TELLING)
    monkeypatch.setattr(module, "rank", lambda *_: little)
    monkeypatch.setattr(Found, "taken", lambda at, found: at._replace(selected=found.ranked[:1]))
    at = Found(BENCH, SimpleNamespace(scored=scored), (), (), refit(0.0))
    assert len(_numbers(at, (), chain(), (), silent).selected) == named


def test_beside_a_law_numbers_are_ranked_only_where_a_quick_fit_of_one_hints_at_it(monkeypatch):
    """Else minutes would go into telling apart what no records tell."""
    hints = {"stiffness_error": 0.4 * TELLING, "input_gain": 0.3 * TELLING}
    off = candidate("stiffness_error", B12), candidate("input_gain", {"input": "drive"})
    monkeypatch.setattr(module, "numbers_off", lambda *_: off)
    monkeypatch.setattr(module, "hint", lambda bench, found, x, effort: hints[x.kind])
    ranked_ones = []
    monkeypatch.setattr(
        module, "rank", lambda bench, found, *_: ranked_ones.append(found) or ranking(-1.0, without=-1.0)
    )
    at = Found(BENCH, SimpleNamespace(scored="places"), (), (), refit(0.0))
    assert _numbers(at, (), chain(), (), silent) is at
    assert not ranked_ones
    hints["input_gain"] = 0.6 * TELLING
    _numbers(at, (), chain(), (), silent)
    assert ranked_ones == [off]


def test_a_number_under_which_the_motion_grows_without_bound_is_refused(monkeypatch):
    """As a whole fit of it may, with a law of the wrong sign, though its windows alone do not."""
    off = candidate("stiffness_error", B12)
    much = ranking(0.0, without=-1e4, kinds=[("stiffness_error", B12)])
    monkeypatch.setattr(module, "numbers_off", lambda *_: (off,))
    monkeypatch.setattr(module, "hint", lambda *_: 2 * TELLING)
    monkeypatch.setattr(module, "rank", lambda *_: much)
    monkeypatch.setattr(module, "_reconsidered", lambda at, *_: at)
    monkeypatch.setattr(module, "looked", lambda *_: LOOKED)
    first = ranking(-5.0).ranked[:1]
    at = Found(BENCH, SimpleNamespace(scored="places"), (ranking(-5.0),), first, refit(-5.0))
    for evidence, named in ((0.0, ["cubic_stiffness", "stiffness_error"]), (-np.inf, ["cubic_stiffness"])):

        def taken(at, of, evidence=evidence):
            return at._replace(selected=(*at.selected, of.ranked[0]), before=refit(evidence))

        monkeypatch.setattr(Found, "taken", taken)
        found = _numbers(at, (), chain(), (), silent)
        assert [x.kind for x in found.selected] == named
        assert found.holds


# effects asked again

LOOKED, AGAIN = SimpleNamespace(clear=True), SimpleNamespace(clear=True)


def explained(kind, place, evidence, effects):
    of = Hypothesis(tuple(Effect(k, tuple(p.items()), {"size": -1.0}) for k, p in effects))
    return Explanation(kind, place, refit(evidence, hypothesis=of), evidence, 0.9, 1.0)


@pytest.fixture
def two(monkeypatch):
    """A cubic spring and, found later, hysteresis elsewhere; evidence by what a hypothesis holds."""
    cubic, later = ("cubic_stiffness", B12), ("hysteresis", B23)
    selected = explained(*cubic, -500.0, [cubic]), explained(*later, 0.0, [cubic, later])
    rounds = ranking(-500.0, -600.0), ranking(0.0, kinds=[later])
    at = Found(BENCH, LOOKED, rounds, selected, selected[-1].refit)
    monkeypatch.setattr(module, "states_without", lambda found, row: ())
    monkeypatch.setattr(module, "changes_of", lambda found, bench: None)
    monkeypatch.setattr(module, "looked", lambda *_: AGAIN)
    monkeypatch.setattr(
        module, "candidates_of", lambda look: (candidate("coulomb_friction", B23, force=1.0),)
    )
    monkeypatch.setattr(module, "tied", lambda bench, found, **_: (bench, found))
    monkeypatch.setattr(module, "resolved", lambda bench, found, **_: bench)
    monkeypatch.setattr(module, "weighed_anew", lambda bench, found, **_: bench)

    def set_up(evidences, deviation=0.1):
        """(cubic, backlash, neither) beside hysteresis, and how well the first one's number is known."""
        value = dict(zip(("cubic_stiffness", "backlash", None), evidences, strict=True))
        asked = []

        def fitted(bench, hypothesis, **_):
            kinds = [e.kind for e in hypothesis.effects]
            first = next((k for k in kinds if k != "hysteresis"), None)
            here = value.get(first, -1e4) if "hysteresis" in kinds else -500.0
            return refit(here, hypothesis=hypothesis)

        def rank_again(bench, found, x, others, without, effort, say):
            asked.append([y.kind for y in (x, *others)])
            candidates = [again(x, x.refit), *others]
            every = [(c, fitted(bench, extended(without.hypothesis, c, {}))) for c in candidates]
            return ranked([(c, r, r.fit.evidence, 1.0) for c, r in every], without, BENCH, TEMPERATURE)

        monkeypatch.setattr(module, "refitted", fitted)
        monkeypatch.setattr(module, "rank_again", rank_again)
        whole = at.before._replace(deviations=({"size": deviation}, {"size": 0.1}))
        found = _reconsidered(at._replace(before=whole), chain(), (), silent)
        # what was next to it, and what comes first beside the other
        assert asked[0] == ["cubic_stiffness", "backlash", "coulomb_friction"]
        return found, asked

    return set_up


def test_an_effect_that_holds_beside_a_later_one_stays(two):
    found, asked = two((0.0, -20.0, -300.0))
    assert [x.kind for x in found.selected] == ["cubic_stiffness", "hysteresis"]
    assert len(asked) == 1
    assert found.look is LOOKED
    # its probability is that beside the later one
    assert found.selected[0].probability == pytest.approx(1 / (1 + math.exp(-20 / TEMPERATURE)), abs=1e-6)
    assert found.rounds[0].ranked[0].probability == found.selected[0].probability


def test_another_effect_takes_its_place(two):
    found, asked = two((-100.0, 0.0, -300.0))
    assert [x.kind for x in found.selected] == ["backlash", "hysteresis"]
    assert [len(x.refit.hypothesis.effects) for x in found.selected] == [1, 2]
    assert found.before is found.selected[-1].refit
    assert found.look is AGAIN
    # then the later one is asked again beside it, next to what comes first and other laws of its place
    assert asked[1:] == [["hysteresis", "coulomb_friction", "coulomb_friction"]]


def test_another_under_which_the_motion_grows_without_bound_does_not(two, monkeypatch):
    real = module._in_place
    monkeypatch.setattr(module, "_in_place", lambda *x: real(*x)._replace(before=refit(-np.inf)))
    found, _ = two((-100.0, 0.0, -300.0))
    assert [x.kind for x in found.selected] == ["cubic_stiffness", "hysteresis"]
    assert found.look is LOOKED


def test_an_effect_that_a_later_one_makes_needless_is_left_out(two):
    found, _ = two((0.0, 0.0, -WORTH * TEMPERATURE * 0.9))
    assert [x.kind for x in found.selected] == ["hysteresis"]
    assert len(found.rounds) == 1
    assert found.before is found.selected[-1].refit
    assert [e.kind for e in found.before.hypothesis.effects] == ["hysteresis"]


def test_an_effect_of_which_no_number_is_told_from_zero_is_left_out(two):
    before, _ = two((0.0, -20.0, -300.0))
    known = before.selected[0]
    assert known.told
    unknown = known._replace(refit=before.before._replace(deviations=({"size": 0.4}, {"size": 0.1})))
    assert not unknown.told
    # the other one of the same fit is
    assert unknown._replace(kind="hysteresis", place=B23).told
    # and so are numbers of the model, which have their own deviations
    assert unknown._replace(kind="mass_error", place={"body": "b1"}).told
    found, _ = two((0.0, -20.0, -300.0), deviation=0.4)
    assert [x.kind for x in found.selected] == ["hysteresis"]


# verdicts


def test_an_offset_is_no_noise():
    signals = 0.1 * np.random.default_rng(0).standard_normal((4096, 2)) + np.array([5.0, 0.0])
    found = residual_noise(signals)
    np.testing.assert_allclose(found.level, 0.1, rtol=0.05)
    np.testing.assert_allclose(found.rms(), 0.1, rtol=0.05)


def test_computed_records_have_a_least_noise():
    u = drive(SAMPLES, periods=4)
    y = exact(u)
    (noise,) = noise_of(chain(), [record(u, y)])
    rms = np.sqrt((y**2).mean(axis=0))
    assert (noise.level >= FINEST * rms).all()
    assert (noise.level < 1e-2 * rms).all()


def told(found):
    (selected,) = found.as_dict()["selected"]
    return selected["kind"], selected["place"], selected["parameters"]


@pytest.mark.slow
def test_a_bias_is_found_although_the_noise_is_not_told():
    u = drive()
    y = noisy(exact(u))
    offset = 0.2 * y[:, 1].std()
    y[:, 1] += offset
    found = diagnose(chain(), record(u, y))
    kind, place, parameters = told(found)
    assert (found.verdict, kind, place) == ("effect", "sensor_bias", {"sensor": "s1"})
    assert abs(parameters["offset"]["value"] - offset) < 3 * parameters["offset"]["std"]


@pytest.mark.slow
def test_a_load_is_found_although_the_noise_is_not_told():
    u = drive()
    kinds = tuple((body, "displacement") for body in range(3))
    # a load that was there before the record adds its static displacements
    static = np.linalg.solve(np.asarray(second_order(chain()).stiffness), [0.0, 3.0, 0.0])
    y = noisy(exact(u, kinds)) + static
    found = diagnose(chain(kinds), record(u, y, kinds))
    kind, place, parameters = told(found)
    assert (found.verdict, kind, place) == ("effect", "constant_load", {"body": "b2"})
    assert abs(parameters["force"]["value"] - 3.0) < 3 * parameters["force"]["std"]


@pytest.mark.slow
def test_periodic_records_without_noise_are_diagnosed():
    u = drive(SAMPLES, periods=4)
    found = diagnose(chain(factor=1.02), record(u, exact(u)))
    assert found.verdict == "effect"
    assert {x["kind"] for x in found.as_dict()["selected"]} == {"stiffness_error"}
    assert found.closure.fraction > 0.99
