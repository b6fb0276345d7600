"""Laws of any shape at a place: the F test against least squares by SciPy, laws that are right and that are not."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from effects_truth import Chain, Truth
from gap_bench import bench, colored, continuous, stepped, whitened, windows_of
from gap_helpers import DT, JOINT, SENSED, chain, drive, record, silent
from test_gap_verdict import causes, closure, examination, ranking

from jaxsid import diagnose
from jaxsid.gap.any_law import _without_states, any_law, smooth_places
from jaxsid.gap.causes import _doubted, _unlisted
from jaxsid.gap.f_test import f_test
from jaxsid.gap.look import Look
from jaxsid.gap.null import Null
from jaxsid.gap.places import Place
from jaxsid.gap.ranking import ends_of
from jaxsid.gap.refit import Bench, Hypothesis, refitted
from jaxsid.gap.search import Found
from jaxsid.gap.shooting import slopes
from jaxsid.gap.verdict import LAPSE, OTHER, verdict_of
from jaxsid.gap.words import about_doubt
from jaxsid.mechanics.lumped import Effect, second_order
from jaxsid.physical.elements import element_matrices

B12, B23 = Place("between", ("b1", "b2")), Place("between", ("b2", "b3"))
CUBIC = Hypothesis((Effect("cubic_stiffness", (("between", B12.ends),), {"coefficient": 4e5}),))


def reading(kind, parameters, law=None):
    """Noisy readings of the chain with a law between its first two bodies, by the reference integration."""
    plain = second_order(chain())
    truth = Truth(
        Chain(*(np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness)), 0, SENSED),
        kind,
        JOINT,
        parameters,
        DT,
    )
    if law is not None:
        truth.law = lambda t, x: law(truth.e @ x[:3], truth.e @ x[3:6])
    return colored(truth.run(drive()), 1)


def fitted_to(y, level, hypothesis=CUBIC):
    of = bench(y, level)
    return of, refitted(of, hypothesis)


def left(p_value, scored, loose=np.inf, selected=()):
    """How far a search has come, and a look at what is left."""
    of = Bench(**dict.fromkeys(Bench._fields))._replace(loose=loose)
    return Found(of, Look(None, Null(p_value, 0.1, (), ()), scored), (), tuple(selected), SimpleNamespace())


def least_squares(columns, y):
    return float(((y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]) ** 2).sum())


@pytest.mark.parametrize("asked", [1, 3])
def test_f_test_against_least_squares(asked):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((200, 4 + asked)) * np.logspace(-6, 6, 4 + asked)
    y = x[:, 1] * 3 + 0.1 * x[:, -1] / np.abs(x[:, -1]).max() + 0.3 * rng.standard_normal(200)
    every = np.column_stack([x, y])
    found = f_test(every.T @ every, 4, 196)
    without, with_all = least_squares(x[:, :4], y), least_squares(x, y)
    rest = 196 - asked
    ratio = (without - with_all) / asked / (with_all / rest)
    assert found.p_value == pytest.approx(scipy.stats.f.sf(ratio, asked, rest), rel=1e-6)
    beyond = max(without - with_all - with_all * asked / rest, 0) / without
    assert found.part == pytest.approx(beyond, rel=1e-6, abs=1e-12)


def test_f_test_of_nothing_is_chance():
    gram = np.diag([1.0, 0.0, 2.0])
    assert f_test(gram, 1, 100) == (1.0, 0.0)
    assert f_test(np.diag([1.0, 1.0, 0.0]), 1, 100) == (1.0, 0.0)


def test_against_responses_by_scipy():
    """Of the linear model, whose answers to ramped forces SciPy gives; slopes by the elements are differences."""
    of, found = fitted_to(*reading("quadratic_damping", {"coefficient": 0.1}), Hypothesis())
    theta, place = found.fit.theta[:9], np.array([-1.0, 1.0, 0.0])
    windows = [
        (push[: len(told)], told, weight, begin, block.lead)
        for block, states in zip(of.blocks, found.fit.states, strict=True)
        for push, told, weight, begin in zip(*windows_of(block), states[:, :6], strict=True)
    ]
    plain = stepped(of.model, theta)
    motions = [_across(_run(plain, push, begin)[0], place) for push, _, _, begin, _ in windows]
    largest = np.max([np.abs(m).max(axis=0) for m in motions], axis=0)
    A, inverse = continuous(of.model, theta)
    pushed = (inverse @ place)[:, None]
    port = scipy.signal.StateSpace(A, np.concatenate([0 * pushed, pushed]), A[3:], pushed)
    near = [(stepped(of.model, theta + h), stepped(of.model, theta - h)) for h in 1e-6 * np.eye(9)]
    slopes, answers, free, left = [], [], [], []
    for (push, told, weight, begin, lead), moved in zip(windows, motions, strict=True):
        white = lambda x, w=weight, n=lead: whitened(x[None], w[None], n).ravel()  # noqa: E731
        read = lambda step, push=push, begin=begin: _run(step, push, begin)[1]  # noqa: E731
        d, v = (moved / largest).T
        forces = [np.maximum(z - at, 0) for z in (d, v) for at in np.linspace(-0.75, 0.75, 7)]
        forces += [1 + 0 * d, d, v, d * v, d**2 * v, d * v**2, np.abs(d) * v]
        time = DT * np.arange(len(d))
        slopes.append([white((read(above) - read(below)) / 2e-6) for above, below in near])
        answers.append([white(scipy.signal.lsim(port, f, time)[1]) for f in forces])
        free.append(np.array([white(_run(plain, 0 * push, e)[1]) for e in np.eye(6)]).T)
        left.append(white(read(plain) - told))
    side = lambda x: np.concatenate([np.array(rows).T for rows in x])  # noqa: E731
    # what is likely beforehand counts like any other row
    base = np.block(
        [
            [side(slopes), scipy.linalg.block_diag(*free)],
            [np.diag(1 / of.tolerance), np.zeros((9, 6 * len(free)))],
        ]
    )
    further = np.pad(side(answers), ((0, 9), (0, 0)))
    further /= np.linalg.norm(further, axis=0)
    rest = np.concatenate([*left, theta / of.tolerance])
    without, with_all = least_squares(base, rest), least_squares(np.column_stack([base, further]), rest)
    asked, fitted = further.shape[1], len(found.fit.theta) + 8 * len(windows)
    degrees = found.fit.equations - fitted - asked
    expected = scipy.stats.f.logsf((without - with_all) / asked / (with_all / degrees), asked, degrees)
    assert -60 < expected < -5
    assert np.log(any_law(of, found, B12).p_value) == pytest.approx(expected, rel=0.01)


def _run(step, push, begin):
    """States and readings of the linear chain, sample by sample."""
    x, states, y = begin, [], []
    for force in push:
        states.append(x)
        y.append(step.C @ x + step.D * force)
        x = step.E @ x + step.F * force
    return np.array(states), np.array(y)


def _across(states, place):
    return np.stack([states[:, :3] @ place, states[:, 3:] @ place], axis=1)


# laws that are there, and laws that stand for others


@pytest.mark.slow
def test_a_law_that_is_there_leaves_nothing_to_another():
    of, found = fitted_to(*reading("cubic_stiffness", {"coefficient": 1e6}))
    assert found.fit.squares / found.fit.equations == pytest.approx(1, abs=0.1)
    assert any_law(of, found, B12).p_value > 0.01


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(lambda d, v: 3e4 * d**2 * v, marks=pytest.mark.slow),
        pytest.param(lambda d, v: 4.0 * max(v, 0.0), marks=pytest.mark.slow),
        lambda d, v: 1e9 * d**5,
    ],
    ids=["displacement damping", "one-sided damping", "fifth order"],
)
def test_a_law_that_stands_for_another_leaves_it_what_that_has_of_its_own(law):
    of, found = fitted_to(*reading("none", {}, law))
    told = any_law(of, found, B12)
    assert told.p_value < 1e-9
    assert any_law(of, found, B23).part < told.part
    # nearly all of what is left
    beyond = 1 - found.fit.equations / found.fit.squares
    assert told.part > 0.8 * beyond


@pytest.mark.parametrize(
    ("law", "straight"), [(lambda d, v: 4.0 * max(v, 0.0), False), (lambda d, v: 2.0 * v, True)]
)
def test_a_damper_that_is_off_stands_for_no_damper_of_one_direction(law, straight):
    wrong = [x.name for x in element_matrices(chain()).listed].index("c2.damping")
    of, found = fitted_to(*reading("none", {}, law), Hypothesis(wrong=(wrong,)))
    assert found.fit.theta[wrong] > 0.4
    assert (any_law(of, found, B12).p_value > 0.01) == straight


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "verdict"), [(lambda d, v: 3e4 * d**2 * v, "unknown"), (lambda d, v: 1e6 * d**3, "effect")]
)
def test_a_law_that_is_not_in_the_catalogue_is_unknown_at_its_place(law, verdict):
    found = diagnose(chain(), record(drive(), reading("none", {}, law)[0]))
    assert found.verdict == verdict
    assert found.examination.locations.ranked[0].place == B12


def test_motion_that_grows_without_bound_tells_nothing(monkeypatch):
    def grown(*given):
        rows, lefts = slopes(*given)
        return jnp.full_like(rows, jnp.nan), lefts

    of, found = fitted_to(*reading("cubic_stiffness", {"coefficient": 1e5}))
    monkeypatch.setattr("jaxsid.gap.any_law.slopes", grown)
    assert any_law(of, found, B12) == (1.0, 0.0)


def test_places_of_smooth_laws_alone():
    def of(*found):
        return smooth_places([ranking(0.0, kinds=[x]).ranked[0] for x in found])

    here, wall = {"between": ("b1", "b2")}, {"between": ("ground", "b1")}
    assert of(("cubic_stiffness", here)) == (B12,)
    assert of(("cubic_stiffness", here), ("end_stop", {"between": ("b2", "b1")})) == (B12,)
    assert of(("quadratic_damping", wall)) == (Place("between", ("b1", "ground")),)
    assert of(("constant_load", {"body": "b1"}), ("cubic_stiffness", here)) == (B12,)
    assert (
        of(("stiffness_error", here))
        == of(("damping_error", here), ("sensor_bias", {"sensor": "s1"}))
        == (B12,)
    )
    # dry friction, memory, time, masses and signals are no sum of shapes
    assert of(("coulomb_friction", here), ("cubic_stiffness", here)) == ()
    assert of(("constant_load", {"body": "b1"}), ("coulomb_friction", wall)) == ()
    assert of(("hysteresis", here)) == of(("time_varying_stiffness", here)) == ()
    assert of(("mass_error", {"body": "b1"})) == of(("sensor_gain", {"sensor": "s1"})) == ()
    assert of(("missing_mode", {"body": "b1"})) == of(("periodic_disturbance", {"body": "b1"})) == ()


@pytest.mark.parametrize(
    ("chance", "loose", "asked"), [(1e-12, np.inf, True), (1e-3, np.inf, False), (1e-12, 0.1, None)]
)
def test_asked_where_windows_are_long(monkeypatch, chance, loose, asked):
    called = []

    def stand_in(*given):
        called.append(given)
        return SimpleNamespace(p_value=chance)

    monkeypatch.setattr("jaxsid.gap.causes.any_law", stand_in)
    selected = ranking(0.0, kinds=[("cubic_stiffness", B12.as_dict())]).ranked[:1]
    said = []
    found = _unlisted(left(1e-4, None, loose, selected), examination(), said.append)
    assert found == ((B12,) if asked else ())
    assert bool(called) == bool(said) == (asked is not None)


def test_asked_where_tests_find_anything_or_refute_the_linear_models_of_which_one_was_found():
    def of(p_value, finding, *found):
        selected = [ranking(0.0, kinds=[x]).ranked[0] for x in found]
        return _doubted(examination()._replace(finding=finding), left(p_value, None).look, selected)

    law, spring = ("cubic_stiffness", B12.as_dict()), ("stiffness_error", B12.as_dict())
    mass = ("mass_error", {"body": "b1"})
    assert of(1e-4, "structure", law)
    assert of(1e-4, "parameters", spring)
    assert not of(0.1, "structure", law)
    assert not of(0.1, "structure", spring, law)
    assert of(0.1, "structure", spring, mass)
    assert not of(0.1, "parameters", spring, mass)


@pytest.mark.parametrize(("left_at", "told"), [((B12,), (B12,)), ((B23, B12), (B12,)), ((B23,), ())])
def test_what_arises_elsewhere_is_for_another_effect(monkeypatch, left_at, told):
    monkeypatch.setattr("jaxsid.gap.causes.any_law", lambda *_: SimpleNamespace(p_value=0.0))
    monkeypatch.setattr("jaxsid.gap.causes.located", lambda x: SimpleNamespace(likely=x))
    selected = ranking(0.0, kinds=[("cubic_stiffness", {"between": ("b2", "b1")})]).ranked[:1]
    assert _unlisted(left(0.0, left_at, selected=selected), examination(), silent) == told


def two_laws(u, strong, weak, steps=20):
    """Accelerations of the chain with laws between its first two bodies and of its second on the ground, by RK4."""
    plain, ends = second_order(chain()), np.array([[-1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    M, D, K = (np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness))
    h, x, y = DT / steps, np.zeros(6), []

    def rate(x, force):
        laws = [law(e @ x[:3], e @ x[3:]) for law, e in zip((strong, weak), ends, strict=True)]
        pushed = np.array([force, 0, 0]) - D @ x[3:] - K @ x[:3] - np.array(laws) @ ends
        return np.concatenate([x[3:], np.linalg.solve(M, pushed)])

    for force in u:
        y.append(rate(x, force)[3:])
        for _ in range(steps):
            a = rate(x, force)
            b = rate(x + h / 2 * a, force)
            c = rate(x + h / 2 * b, force)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, force))
    return np.array(y)


@pytest.mark.slow
def test_a_small_effect_elsewhere_is_looked_for_before_a_law_of_another_shape_is_claimed(monkeypatch):
    """Friction of 1.3 times the noise, 0.13 % of the response, beside a spring that is doubted."""
    y = two_laws(drive(), lambda d, v: 1e6 * d**3, lambda d, v: 3e-3 * np.tanh(v / 1e-4))
    y = y + 1e-3 * y.std(axis=0) * np.random.default_rng(1).standard_normal(y.shape)
    real, asked = any_law, []

    def doubting(bench, found, place):
        asked.append(place)
        return real(bench, found, place) if len(asked) > 1 else SimpleNamespace(p_value=0.0)

    monkeypatch.setattr("jaxsid.gap.causes.any_law", doubting)
    found = diagnose(chain(), record(drive(), y))
    assert found.verdict == "effect"
    laws = [(x.kind, set(ends_of(x.place)[1:])) for x in found.causes.selected]
    assert laws == [("cubic_stiffness", {"b1", "b2"}), ("coulomb_friction", {"ground", "b2"})]
    assert found.causes.unlisted == ()
    assert found.causes.remaining.p_value > 0.01


def test_a_law_beside_which_another_is_sure_is_not_in_the_catalogue():
    found = causes(
        ranking(
            0.0, -500.0, kinds=[("cubic_stiffness", {"between": ("b2", "b1")}), ("hysteresis", B23.as_dict())]
        ),
        closures=[closure(0.011)],
    )
    sure = verdict_of(examination(), found)
    assert (sure.name, sure.imitating) == ("effect", ())
    assert sure.probability["unknown"] == pytest.approx(LAPSE, abs=0.01)
    doubt = verdict_of(examination(), found._replace(unlisted=(B12,)))
    assert doubt.name == "unknown"
    assert doubt.probability["unknown"] == OTHER
    assert [x.kind for x in doubt.imitating] == ["cubic_stiffness"]
    assert not doubt.paired
    # the reader is told why what leaves so little is not taken
    (reason,) = about_doubt(found._replace(unlisted=(B12,)), doubt)
    assert "cubic stiffness between b2 and b1" in reason
    assert "another shape" in reason
    assert about_doubt(found, sure) == []


def test_what_states_take_up_leaves_no_negative_squares():
    """Rounding is all that is left of them; of all else what least squares leave, states' likely sizes in rows."""
    rng = np.random.default_rng(3)
    states, taken = rng.normal(size=(6, 40, 4)), rng.normal(size=(6, 4, 5))
    columns, last = 1e8 * states @ taken, states @ rng.normal(size=(6, 4, 1))
    unknowns, deviations = rng.normal(size=(6, 40, 2)), np.full(4, 1e9)
    gram = _without_states(np.concatenate([unknowns, states, last], axis=2), columns, 2, deviations)
    assert (np.diag(gram) >= 0).all()
    left = 0.0
    for own, x in zip(states, unknowns, strict=True):
        a = np.concatenate([own, np.diag(1 / deviations)])
        b = np.concatenate([x, np.zeros((4, 2))])
        rest = b - a @ np.linalg.lstsq(a, b, rcond=None)[0]
        left = left + rest.T @ rest
    np.testing.assert_allclose(gram[:2, :2], left, rtol=1e-10)
