"""Laws of fewer numbers begin where the best law at their place ended."""

from types import MappingProxyType, SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from effects_truth import GROUND
from gap_helpers import chain, drive, noisy, record, silent, with_effect
from test_gap_causes import B12, B23, BENCH, candidate, refit

from jaxsid.gap import nested as module
from jaxsid.gap.examine import examine
from jaxsid.gap.explain import TEMPERATURE, extended
from jaxsid.gap.nested import FEWER, NEAR, nested
from jaxsid.gap.ranking import Whole, key_of, left_in, ranked
from jaxsid.gap.refit import Hypothesis, bench_of, refitted
from jaxsid.mechanics.lumped import Effect

FRICTION, FORCE, STEPS = {"between": ("ground", "b2")}, 0.8, 30
STATES = (np.zeros((1, 6)),)  # of the best one


def round_of(*laws, errors=MappingProxyType({})):
    """Kind, place, evidence, and rms that is left, best first."""
    every = []
    for kind, place, evidence, left in laws:
        c = candidate(kind, place)
        every.append((c, refit(evidence, hypothesis=extended(Hypothesis(), c, errors)), evidence, left))
    return ranked(every, refit(-1e9), BENCH, TEMPERATURE)


@pytest.fixture
def begun(monkeypatch):
    """Kinds that are begun at the best one's states, each with evidence as told."""

    def run(first, evidences):
        fitted = []

        def fit(bench, hypothesis, *, states, steps, **_):
            assert states is STATES
            if steps == 1:  # only how much it leaves there
                return refit(0.0, hypothesis=hypothesis)
            fitted.append(hypothesis.effects[-1].kind)
            return refit(evidences[fitted[-1]], hypothesis=hypothesis)

        monkeypatch.setattr(module, "refitted", fit)
        monkeypatch.setattr(module, "states_without", lambda found, row: STATES)
        monkeypatch.setattr(module, "changes_of", lambda found, bench: None)
        monkeypatch.setattr(module, "value", lambda found, bench: found.fit.evidence)
        monkeypatch.setattr(module, "left_in", lambda bench, whole: 1.0)
        monkeypatch.setattr(module, "side_by_side", lambda f, xs: [f(x) for x in xs])
        return nested(first, STEPS, silent), fitted

    return run


def test_only_those_within_the_best_one_are_begun_there(begun):
    first = round_of(
        ("stribeck_friction", B12, 0.0, 1.0),
        ("hysteresis", B12, -1.0, 1.1),  # more numbers
        ("coulomb_friction", B23, -2.0, 1.1),  # elsewhere
        ("quadratic_damping", B12, -3.0, 1.1 * NEAR),  # far off
        ("backlash", B12, -4.0, 1.3),
        ("coulomb_friction", B12, -5.0, 1.3),
        ("cubic_stiffness", B12, -6.0, 1.4),
    )
    found, fitted = begun(first, {"backlash": -4.5, "coulomb_friction": -5.5})
    assert fitted == ["backlash", "coulomb_friction"]
    assert len(fitted) == FEWER
    assert found is first


def test_what_ends_better_from_there_takes_its_place(begun):
    first = round_of(("stribeck_friction", B12, 0.0, 1.0), ("coulomb_friction", B12, -500.0, 1.3))
    found, _ = begun(first, {"coulomb_friction": 20.0})
    assert [(x.kind, x.evidence) for x in found.ranked] == [
        ("coulomb_friction", 20.0),
        ("stribeck_friction", 0.0),
    ]
    assert found.ranked[0].left == 1.0


def test_a_round_of_nothing_stays(begun):
    empty = ranked([], refit(-1e9), BENCH, TEMPERATURE)
    assert nested(empty, STEPS, silent) is empty
    alone = round_of(("coulomb_friction", B12, 0.0, 1.0))
    assert nested(alone, STEPS, silent) is alone


def test_a_wrong_number_of_the_model_holds_no_other_law(begun):
    errors = {key_of("damping_error", B12): (4,)}
    laws = ("damping_error", B12, 0.0, 1.0), ("coulomb_friction", B12, -1.0, 1.1)
    first = round_of(*laws, errors=errors)
    assert begun(first, {}) == (first, [])


@pytest.fixture(scope="module")
def rubbed():
    """Records of a chain with dry friction, and fits of Stribeck's law at its place."""
    model = chain()
    u = drive(seed=5)
    y = with_effect(u, "coulomb_friction", (GROUND, 1), {"force": FORCE})
    seen = [record(u, noisy(y, seed=6))]
    found = examine(model, seen)
    bench = bench_of(model, seen, found.noises, found.fit)
    more = {"force": FORCE, "static_force": FORCE, "velocity": 0.01}
    stribeck = Effect("stribeck_friction", tuple(FRICTION.items()), more)
    return SimpleNamespace(bench=bench, best=refitted(bench, Hypothesis((stribeck,)), steps=STEPS))


@pytest.mark.slow
def test_coulombs_law_gets_out_of_a_wrong_valley(rubbed):
    bench, best = rubbed.bench, rubbed.best
    wrong = Effect("coulomb_friction", tuple(FRICTION.items()), {"force": jnp.asarray(0.3)})
    stuck = refitted(bench, Hypothesis((wrong,)), steps=2)
    left = lambda x: left_in(bench, Whole(bench, x))  # noqa: E731
    every = [
        (candidate(kind, FRICTION), x, x.fit.evidence, left(x))
        for kind, x in (("stribeck_friction", best), ("coulomb_friction", stuck))
    ]
    first = ranked(every, refitted(bench, Hypothesis(), steps=STEPS), bench, TEMPERATURE)
    assert first.ranked[0].kind == "stribeck_friction"
    assert first.ranked[1].left < NEAR * first.ranked[0].left
    found = nested(first, STEPS, silent)
    assert found.ranked[0].kind == "coulomb_friction"
    (effect,) = found.ranked[0].refit.hypothesis.effects
    assert float(np.asarray(effect.parameters["force"])) == pytest.approx(FORCE, rel=0.02)
    # what Stribeck's law has beyond it tells nothing
    assert found.ranked[0].left == pytest.approx(found.ranked[1].left, rel=0.01)


@pytest.mark.parametrize("right", [1.0, 0.25, 0.0625])
def test_one_of_a_single_number_begins_with_the_part_of_it_that_leaves_least(monkeypatch, right):
    """What another valley made of the number may be many times what this one needs."""
    started = []

    def fit(bench, hypothesis, *, steps, **_):
        number = float(hypothesis.effects[-1].parameters["coefficient"])
        if steps > 1:
            started.append(number)
        return refit(0.0, squares=abs(number - 8.0 * right), hypothesis=hypothesis)

    first = round_of(("hysteresis", B12, 0.0, 1.0), ("cubic_stiffness", B12, -500.0, 1.3))
    begin, cubic = first.ranked
    of = Hypothesis((Effect("cubic_stiffness", tuple(B12.items()), {"coefficient": 8.0}),))
    cubic = cubic._replace(refit=refit(-500.0, hypothesis=of))
    monkeypatch.setattr(module, "refitted", fit)
    monkeypatch.setattr(module, "states_without", lambda found, row: STATES)
    monkeypatch.setattr(module, "changes_of", lambda found, bench: None)
    monkeypatch.setattr(module, "value", lambda found, bench: -1e3)
    nested(first._replace(ranked=(begin, cubic)), STEPS, silent)
    assert started == [8.0 * right]
