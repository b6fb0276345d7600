"""A law that holds the one found: begun where that ended, taken where else a number of the model would be off there."""

from types import SimpleNamespace
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from effects_truth import GROUND
from gap_helpers import chain, drive, noisy, record, silent, with_effect
from test_gap_causes import BENCH, candidate, refit

from jaxsid.gap import search
from jaxsid.gap.examine import examine
from jaxsid.gap.explain import NUMBERS, TEMPERATURE
from jaxsid.gap.ranking import ranked
from jaxsid.gap.refit import Hypothesis, bench_of, refitted
from jaxsid.gap.search import TELLING, Found
from jaxsid.gap.wider import APART, STARTS, wider
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Effect

PLACE = {"between": ("ground", "b2")}
FALLING = {"force": 1.0, "static_force": 2.0, "velocity": 0.25}  # within the motion's speeds, 0.2 m/s rms
STEPS = 30


def coulomb(force):
    return Effect("coulomb_friction", tuple(PLACE.items()), {"force": force})


@pytest.mark.parametrize("kind", [k for k in CATALOGUE.values() if k.holds])
def test_a_law_is_what_it_holds_where_its_numbers_of_one_unit_are_equal(kind):
    plain = CATALOGUE[kind.holds]
    (number,) = plain.parameters
    values = [jnp.asarray(0.7 if p.unit == number.unit else 1.3) for p in kind.parameters]
    speed = jnp.linspace(0.0, 3.0, 50)
    levels = [np.broadcast_to(of.slip(speed, *x), 50) for of, x in ((kind, values), (plain, values[:1]))]
    assert levels[0] == pytest.approx(levels[1])


@pytest.fixture(scope="module")
def rubbed():
    """Records of a chain with friction that falls with speed, and the fit of Coulomb's law at its place."""
    model, u = chain(), drive(seed=5)
    y = with_effect(u, "stribeck_friction", (GROUND, 1), FALLING)
    seen = [record(u, noisy(y, seed=6))]
    found = examine(model, seen)
    bench = bench_of(model, seen, found.noises, found.fit)
    plain = refitted(bench, Hypothesis((coulomb(1.5),)), steps=STEPS)
    without = refitted(bench, Hypothesis(), steps=STEPS)
    every = [(candidate("coulomb_friction", PLACE), plain, plain.fit.evidence, 1.0)]
    return SimpleNamespace(
        bench=bench, found=plain, without=without, round=ranked(every, without, bench, TEMPERATURE)
    )


@pytest.mark.slow
def test_friction_that_falls_with_speed_is_found_from_where_coulombs_ended(rubbed):
    x = rubbed.round.ranked[0]
    best, *others = wider(rubbed.bench, rubbed.found, x, rubbed.round, rubbed.without, STEPS).ranked
    assert [best.kind, *(y.kind for y in others)] == ["stribeck_friction", "coulomb_friction"]
    (effect,) = best.refit.hypothesis.effects
    for name, value in FALLING.items():
        assert float(np.asarray(effect.parameters[name])) == pytest.approx(value, rel=0.1)
    assert best.left < 0.9 * others[0].left


def test_a_law_that_none_holds_stays(rubbed):
    x = rubbed.round.ranked[0]._replace(kind="stribeck_friction")
    assert wider(rubbed.bench, rubbed.found, x, rubbed.round, rubbed.without, STEPS) is None


@pytest.mark.parametrize(
    ("gain", "hinted", "place", "taken"),
    [
        (2.0, 1.5, PLACE, True),
        (2.0, 2.5, PLACE, False),
        (0.5, 0.1, PLACE, False),
        (2.0, 1.5, {"between": ("ground", "b1")}, False),
    ],
)
def test_it_is_taken_where_it_explains_more_than_a_number_off_at_its_place(
    monkeypatch, gain, hinted, place, taken
):
    """In units of what a number must gain beside an effect."""
    before = refit(0.0, hypothesis=Hypothesis((coulomb(1.0),)))
    old = ranked([(candidate("coulomb_friction", PLACE), before, 0.0, 1.0)], refit(-1e3), BENCH, 1.0)
    evidence = gain * TELLING * NUMBERS.temperature
    laws = [(candidate("stribeck_friction", PLACE), refit(evidence), evidence, 1.0)]
    law = ranked([*laws, (old.ranked[0], before, 0.0, 1.0)], refit(-1e3), BENCH, 1.0)._replace(scale=1.0)
    monkeypatch.setattr(search, "_without", lambda at, x, model: (refit(-1e3), ()))
    monkeypatch.setattr(search, "wider", lambda *_: law)
    monkeypatch.setattr(search, "hint", lambda *_: hinted * TELLING)
    new = Found(cast(Any, None), cast(Any, "new"), (law,), law.ranked[:1], before)
    monkeypatch.setattr(search, "_in_place", lambda at, i, ranking: new if ranking is law else None)
    monkeypatch.setattr(search, "_left", lambda at, model, seen: at)
    at = Found(cast(Any, None), cast(Any, "old"), (old,), old.ranked, before)
    off = [candidate("damping_error", place)]
    found = search._wider(at, off, chain(), [], silent)
    assert found is (new if taken else at)


def test_starts_spread_over_what_the_plain_law_lacks(rubbed):
    from jaxsid.gap.wider import _starts

    every = [e.parameters for e in _starts(CATALOGUE["stribeck_friction"], coulomb(1.5), rubbed.bench)]
    assert len(every) == STARTS
    assert all(p["force"] == 1.5 and p["static_force"] == 1.5 * APART for p in every)
    speeds = np.array([p["velocity"] for p in every])
    rms = np.sqrt(np.mean(rubbed.bench.moved[0].velocities[:, 1] ** 2))
    assert (np.diff(speeds) > 0).all()
    assert speeds[0] < 0.1 * rms < 2 * rms < speeds[-1]
