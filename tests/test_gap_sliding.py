"""A loop that slides is told as friction that gives, with its numbers; one that does not slide stays a loop."""

import numpy as np
import pytest
from gap_helpers import JOINT, chain, drive, noisy, record, silent, with_effect
from test_gap_causes import B12, BENCH, candidate, ranking, refit

from jaxsid.gap.examine import examine
from jaxsid.gap.explain import FIRST, TEMPERATURE, _whole, again, extended
from jaxsid.gap.ranking import Whole, ranked
from jaxsid.gap.refit import FINEST, Hypothesis, bench_of, refitted
from jaxsid.gap.sliding import FAR, FRICTION, LOOP, _begun, sliding
from jaxsid.mechanics.effects.catalogue import CATALOGUE, LAWS, check_effect, law_of
from jaxsid.mechanics.lumped import Effect

GIVING = {"force": 2.0, "static_force": 3.0, "velocity": 0.1, "stiffness": 3000.0}
LOOPING = {"stiffness": 800.0, "beta": 500.0, "gamma": 300.0, "exponent": 1.0}


def round_of(kind, parameters, start):
    """Records of a law between two bodies, and a round in which a loop there comes first."""
    model, u = chain(), drive(seed=1)
    seen = [record(u, noisy(with_effect(u, kind, JOINT, parameters), seed=2))]
    found = examine(model, seen)
    bench = bench_of(model, seen, found.noises, found.fit)
    loop = Effect(LOOP, tuple(B12.items()), start)
    bench, best = _whole(bench, Hypothesis((loop,)), {}, FIRST)
    without = refitted(bench, Hypothesis())
    return ranked([(candidate(LOOP, B12), best, best.fit.evidence, 1.0)], without, bench, TEMPERATURE)


@pytest.mark.slow
def test_a_loop_that_slides_is_friction_with_its_numbers():
    first = round_of("stribeck_friction", GIVING, LOOPING | {"stiffness": 2500.0})
    found = sliding(first, silent)
    assert [x.kind for x in found.ranked] == [FRICTION, LOOP]
    best = found.ranked[0]
    assert best.evidence - first.ranked[0].evidence > 100
    assert best.place == B12
    (effect,), (deviations,) = best.refit.hypothesis.effects, best.refit.deviations
    for name, value in GIVING.items():
        assert abs(float(np.ravel(effect.parameters[name])[0]) - value) < 4 * deviations[name]
        assert deviations[name] < 0.1 * value
    # asked again later it begins with what it has
    new = extended(Hypothesis(), again(best, best.refit), {})
    assert set(new.effects[0].parameters) == set(GIVING)


@pytest.mark.slow
def test_a_loop_stays_one_though_it_slides():
    first = round_of("hysteresis", LOOPING, LOOPING | {"stiffness": 700.0})
    assert _begun(first.bench, first.ranked[0].refit.hypothesis.effects[0])
    assert sliding(first, silent) is first


def test_a_loop_fitted_to_the_bottom_is_asked_with_the_shortest_steps(monkeypatch):
    """Surfaces that hardly give follow at once; all is compared with steps that show it."""
    c, steps = candidate(LOOP, B12, **LOOPING), []
    whole = (np.zeros((1, 6)),) * len(BENCH.blocks)

    def fit(bench, hypothesis, **_):
        steps.append(bench.substeps)
        found = refit(-50.0 if hypothesis.effects[0].kind == FRICTION else -80.0, hypothesis=hypothesis)
        return found._replace(fit=found.fit._replace(states=whole))

    monkeypatch.setattr("jaxsid.gap.sliding._begun", lambda bench, loop: [GIVING])
    monkeypatch.setattr("jaxsid.gap.sliding.refitted", fit)
    monkeypatch.setattr("jaxsid.gap.sliding.changes_of", lambda found, bench: None)
    monkeypatch.setattr("jaxsid.gap.sliding.value", lambda found, bench: found.fit.evidence)
    monkeypatch.setattr("jaxsid.gap.sliding.left_in", lambda bench, whole: 1.0)
    own = refit(-90.0, hypothesis=extended(Hypothesis(), c, {}))
    own = own._replace(fit=own.fit._replace(states=whole))
    first = ranked([(c, own, -90.0, 1.0)], refit(-1e3), BENCH, TEMPERATURE)
    found = sliding(first, silent, Whole(BENCH, own))
    assert steps == [FINEST, FINEST]
    assert [x.kind for x in found.ranked] == [FRICTION, LOOP]
    assert found.ranked[0].evidence - found.ranked[1].evidence == pytest.approx(30.0)
    assert found.bench.substeps == FINEST
    monkeypatch.setattr("jaxsid.gap.sliding.value", lambda found, bench: found.fit.evidence - 31.0)
    assert sliding(first, silent, Whole(BENCH, own)) is first


def test_what_hardly_slides_is_not_tried(monkeypatch):
    at = lambda moved: type("At", (), {"displacement": np.array([moved]), "velocity": np.array([2.0])})()  # noqa: E731
    for name in ("second_order", "effect_slots"):
        monkeypatch.setattr(f"jaxsid.gap.sliding.{name}", lambda *_: None)
    # a limit of 1 / (6 + 3)^(1/2), a third
    loop = Effect(LOOP, tuple(B12.items()), {"stiffness": 30.0, "beta": 6.0, "gamma": 3.0, "exponent": 2.0})
    monkeypatch.setattr("jaxsid.gap.sliding.amplitudes_of", lambda *_: at(0.99 * FAR / 3))
    assert _begun(BENCH, loop) == []
    monkeypatch.setattr("jaxsid.gap.sliding.amplitudes_of", lambda *_: at(1.01 * FAR / 3))
    one, over = _begun(BENCH, loop)
    assert one == pytest.approx({"force": 10.0, "static_force": 10.0, "velocity": 0.6, "stiffness": 30.0})
    assert over["static_force"] == pytest.approx(15.0)
    # nor what would feed the motion
    assert _begun(BENCH, Effect(LOOP, loop.place, loop.parameters | {"gamma": -7.0})) == []


def test_other_rounds_stay_as_they_are():
    assert sliding(other := ranking(0.0), silent) is other
    # friction is there already, or the loop was fitted to a part of the records alone
    friction = Effect(FRICTION, tuple(B12.items()), GIVING)
    for before in (Hypothesis((friction,)), None):
        c = candidate(LOOP, B12)
        fit = refit(0.0, hypothesis=extended(before or Hypothesis(), c, {}))
        states = (np.zeros((1, 6)),) * (len(BENCH.blocks) + (before is None))
        fit = fit._replace(fit=fit.fit._replace(states=states))
        first = ranked([(c, fit, 0.0, 1.0)], refit(-1e3), BENCH, TEMPERATURE)
        assert sliding(first, silent) is first


def test_a_form_of_a_kind_is_told_by_its_parameter():
    rigid = {k: v for k, v in GIVING.items() if k != "stiffness"}
    assert law_of(FRICTION, rigid) is CATALOGUE[FRICTION]
    assert law_of(FRICTION, GIVING) is LAWS["presliding_friction"]
    assert "presliding_friction" not in CATALOGUE
    check_effect(FRICTION, "between", GIVING, "effect")
    with pytest.raises(ValueError, match="its parameter 'velocity' is missing"):
        check_effect(FRICTION, "between", {k: v for k, v in GIVING.items() if k != "velocity"}, "effect")
    with pytest.raises(ValueError, match="it has no parameter 'stifness'"):
        check_effect(FRICTION, "between", rigid | {"stifness": 1.0}, "effect")
