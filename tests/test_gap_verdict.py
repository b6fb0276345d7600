"""What is concluded from explanations that were fitted: verdict, sets, what of them stands."""

import math
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from test_gap_causes import B12, B23, ranking, refit

from jaxsid.gap import null
from jaxsid.gap.causes import Causes
from jaxsid.gap.closure import Closure, Left, fraction
from jaxsid.gap.examine import Examination
from jaxsid.gap.explain import TEMPERATURE
from jaxsid.gap.look import SLIGHT
from jaxsid.gap.noise import Noise
from jaxsid.gap.places import Place
from jaxsid.gap.ranking import LOUD
from jaxsid.gap.recalibrate import Recalibrated
from jaxsid.gap.verdict import (
    IMITATED,
    LAPSE,
    MISSED,
    REMAINDER,
    TWOFOLD,
    Verdict,
    concluded,
    verdict_of,
)
from jaxsid.gap.words import about_doubt, about_held_out
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.effects.kind import Motion


def examination(nominal=1e-9, structural=1e-9, finding="structure"):
    given = dict.fromkeys(Examination._fields)
    said = {"nominal_p_value": nominal, "structural_p_value": structural, "finding": finding}
    return Examination(**{**given, **said})


def closure(after, recalibrated=0.3, floor=0.01, before=0.4):
    ends = fraction(before, after, floor), (0.0, 1.0), fraction(recalibrated, after, floor)
    return Closure(before, recalibrated, after, floor, *ends, {}, {})


def causes(*rounds, closures, seen=None):
    chosen = [r.ranked[0] for r in rounds][: len(closures)]
    last = chosen[-1].refit
    nothing = Left((), ())
    linear = closure(0.3)
    lefts = tuple(nothing for _ in closures)
    ends = nothing, Left((np.ones((1, 1)),), ())
    best = refit(0.0)
    return Causes(
        rounds,
        last,
        tuple(chosen),
        last,
        best,
        tuple(closures),
        lefts,
        seen or closures[-1],
        linear,
        (),
        None,
        None,
        ends,
        (),
    )


def test_none():
    found = verdict_of(examination(0.4, 0.6), None)
    assert (found.name, found.likely) == ("none", ())
    assert found.probability["none"] > 0.99
    assert sum(found.probability.values()) == pytest.approx(1)
    doubtful = verdict_of(examination(0.006, 0.6), None)
    assert 0.5 < doubtful.probability["none"] < 0.6


def test_noise_that_was_guessed_is_a_bound_where_more_than_noise_is_left():
    told = Noise(np.ones(3), np.ones((3, 1)), 500.0, "periods")
    guess = Noise(told.level, told.taps, 0.0, "residual")
    found = causes(ranking(0.0), closures=[closure(0.1)])
    somewhere = SimpleNamespace()
    assert found._replace(noises=(told, guess), places=somewhere).most == "at most "
    assert found._replace(noises=(told, guess), places=None).most == ""
    assert found._replace(noises=(told, told), places=somewhere).most == ""


def test_what_is_far_above_the_noise_is_never_none(monkeypatch):
    # causes that chose nothing, and tests whose share is small beside what is left
    monkeypatch.setattr("jaxsid.gap.look.left_share", lambda fit: 0.1)
    fit = Recalibrated(None, *(np.zeros(1),) * 3, (), (), (), 0.0, 1000)
    tried = causes(ranking(0.0, -1.0), closures=[closure(0.29)])._replace(selected=())
    verdict = {}
    for rms in (0.99 * LOUD, 1.01 * LOUD):
        left = fit._replace(squares=rms**2 * fit.equations)
        found = examination()._replace(
            finding="structure", fit=left, null=null.Null(1e-9, 0.1 * 0.9 * SLIGHT, (), ())
        )
        verdict[rms > LOUD] = verdict_of(found, tried).name
    assert verdict == {False: "none", True: "unknown"}
    marks = tuple(null.Test(name, 0.5, 0.0) for name in (null.COMMON, null.CHANGE))  # of noise
    for tests, said in (marks, "none"), (marks[1:], "unknown"):
        assert verdict_of(found._replace(null=found.null._replace(tests=tests)), tried).name == said


def test_effect():
    found = verdict_of(examination(), causes(ranking(0.0, -200.0), closures=[closure(0.012)]))
    assert found.name == "effect"
    assert [[x.kind for x in likely] for likely in found.likely] == [["cubic_stiffness"]]
    assert found.probability["effect"] == pytest.approx(1 - LAPSE, abs=5e-3)
    assert sum(found.probability.values()) == pytest.approx(1)


def test_an_effect_is_less_sure_where_tests_find_more_than_noise_in_what_it_leaves():
    def unknown(after, floor, places):
        found = causes(ranking(0.0, -200.0), closures=[closure(after, floor=floor)])._replace(places=places)
        return verdict_of(examination(), found).probability["unknown"]

    somewhere = SimpleNamespace()
    assert unknown(0.15, 0.149, None) == pytest.approx(LAPSE, abs=5e-3)
    assert unknown(0.15, 0.149, somewhere) == pytest.approx(REMAINDER, abs=5e-3)
    # next to nothing is left
    assert unknown(0.0101, 0.01, somewhere) == pytest.approx(LAPSE, abs=5e-3)
    # of numbers alone such tests ask nothing
    numbers = examination()._replace(finding="parameters")
    found = causes(ranking(0.0, -200.0), closures=[closure(0.15, floor=0.149)])._replace(places=somewhere)
    assert verdict_of(numbers, found).probability["unknown"] == pytest.approx(LAPSE, abs=5e-3)


def test_a_law_near_enough_stands_though_tests_are_sure_that_it_is_not_exact():
    # Coulomb friction of a real axis: no law of the catalogue is exact there
    kinds = [("coulomb_friction", B12), ("hysteresis", B23)]
    found = causes(ranking(0.0, -200.0, kinds=kinds), closures=[closure(0.00015, 0.000842, 2.2e-6, 0.001976)])
    known = Noise(np.ones(1), np.ones((1, 1)), 500.0, "repeats")
    found = found._replace(
        places=SimpleNamespace(), noises=(known,), remaining=null.Null(0.0, 0.0137, (), ())
    )
    verdict = verdict_of(examination(), found)
    assert verdict.name == "effect"
    assert verdict.probability["unknown"] < 0.35


def test_where_held_out_samples_do_not_show_the_gap_those_seen_tell():
    """A sweep ends where the law does nothing: noise is all that any model leaves of its end."""
    end, clear = closure(0.0978, 0.1234, 0.0969, 0.0978), closure(0.052, 0.43, 0.0515, 1.09)
    found = causes(ranking(0.0, -200.0), closures=[end], seen=clear)
    assert verdict_of(examination(), found).probability["effect"] == pytest.approx(1 - LAPSE, abs=5e-3)
    (said,) = about_held_out(found)
    assert "leaves 9.8 % of them, noise 9.7 %" in said
    assert "left 110 % by the nominal model and 5.2 % with" in said
    # what explains half of the gap there is none, nor what explains half of one that held-out samples do show
    loud = closure(0.55, 0.43, 0.0515, 1.09)
    assert verdict_of(examination(), found._replace(seen=loud)).name == "unknown"
    half = causes(ranking(0.0, -200.0), closures=[closure(0.15, 0.3, 0.0969, 0.3)], seen=clear)
    assert verdict_of(examination(), half).name == "unknown"
    assert about_held_out(half) == about_held_out(None) == []
    # where nothing was found there is nothing to be shown
    assert found._replace(selected=()).telling is end


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("coulomb_friction", "effect"),
        ("stribeck_friction", "effect"),
        ("hysteresis", "effect"),
        ("cubic_stiffness", "unknown"),
        ("backlash", "unknown"),
    ],
)
def test_friction_and_hysteresis_need_not_be_as_exact_as_smooth_laws(kind, name):
    def said(gap):
        left = closure(math.hypot(0.3 * gap, 0.01), recalibrated=math.hypot(0.3, 0.01))
        return verdict_of(
            examination(),
            causes(ranking(0.0, -500.0, kinds=[(kind, B12), ("end_stop", B23)]), closures=[left]),
        )

    assert said(0.3).name == name
    # what leaves half of it explains nothing
    assert said(0.5).name == "unknown"


@pytest.mark.parametrize(
    ("likely", "name"), [((B12,), "effect"), ((B23, B12), "effect"), ((B23,), "unknown"), ((), "unknown")]
)
def test_a_loop_that_leaves_much_stands_only_where_the_force_acts(likely, name):
    where = SimpleNamespace(likely=tuple(Place("between", x["between"]) for x in likely))
    left = closure(math.hypot(0.09, 0.01), recalibrated=math.hypot(0.3, 0.01))
    tried = causes(ranking(0.0, -500.0, kinds=[("hysteresis", B12), ("end_stop", B23)]), closures=[left])
    assert verdict_of(examination()._replace(locations=where), tried).name == name


def test_a_run_over_other_samples_may_leave_more_where_tests_find_nothing_in_those_seen():
    # most of the gap was that of a wrong number; the law explains half of the rest
    def said(after, places):
        left = closure(after, recalibrated=0.0145)
        return verdict_of(
            examination(), causes(ranking(0.0, -500.0), closures=[left])._replace(places=places)
        ).name

    assert said(0.0112, None) == "effect"
    assert said(0.0112, SimpleNamespace()) == "unknown"
    assert said(0.0155, None) == "unknown"


def test_other_samples_tell_little_against_a_law_that_explains_all_of_those_seen():
    # an offset in a frame swept by sines: the rest is what numbers of the model near a resonance miss
    seen = closure(0.01266, 0.01604, 0.01256, 0.0472)
    found = causes(ranking(0.0, -500.0), closures=[closure(0.01267, 0.0157, 0.01004, 0.0665)], seen=seen)
    assert verdict_of(examination(), found).probability["effect"] > 0.95
    # not where tests find more in those seen, nor where it explains little there, nor where far more is left of others
    half = closure(0.0145, 0.01604, 0.01256, 0.0472)
    far = closure(0.0152, 0.018, 0.01004, 0.0665)
    other = (
        found._replace(places=SimpleNamespace()),
        found._replace(seen=half),
        found._replace(closures=(far,)),
    )
    assert [verdict_of(examination(), x).name for x in other] == ["unknown"] * 3
    # unless its numbers, known no better, would leave as much of them: Stribeck's friction beside a wrong mass, most of
    # a stepped sine still to come
    swept = closure(0.01187, 0.01575, 0.00648, 0.2091)
    spread = [swept._replace(unsure=x) for x in (0.01054, 0.0005)]
    assert [verdict_of(examination(), found._replace(closures=(x,))).name for x in spread] == [
        "effect",
        "unknown",
    ]
    # numbers that explain the samples seen, but not others, are none
    seen, others = closure(0.0126, 0.0126, 0.01256, 0.0472), closure(0.03, 0.03, 0.01004, 0.0332)
    apart = causes(ranking(0.0, -500.0), closures=[others], seen=seen)
    assert verdict_of(examination(finding="parameters"), apart).name == "unknown"


@pytest.mark.parametrize(
    ("kind", "unsure", "name"),
    [
        # an end stop in the place of a spring that hardens with the fifth power: nothing is left of the samples seen
        ("end_stop", 0.0009, "unknown"),
        # whose numbers, or whose noise alone, would leave as much of others
        ("end_stop", 0.0028, "effect"),
        # nobody asked how far those are known, or dry friction, never as simple as its law
        ("end_stop", 0.0, "effect"),
        ("coulomb_friction", 0.0009, "effect"),
    ],
)
def test_a_law_that_leaves_more_of_other_samples_than_its_numbers_tell_is_another(kind, unsure, name):
    seen, left = closure(0.01142, 0.01474, 0.01138), closure(0.01418, 0.02257, 0.01338)
    made = ranking(0.0, -500.0, kinds=[(kind, B12), ("backlash", B23)])
    found = causes(made, closures=[left._replace(unsure=unsure)], seen=seen)
    assert found.outrun == (unsure == 0.0009)
    assert not found._replace(places=SimpleNamespace()).outrun
    assert not found.first(0).outrun
    verdict = verdict_of(examination(), found)
    assert (verdict.name, verdict.outrun) == (name, name == "unknown")
    # what comes near is said, and why it is not the law
    assert [x.kind for x in verdict.imitating] == [kind] * verdict.outrun
    assert ["However near end stop" in x for x in about_doubt(found, verdict)] == [True] * verdict.outrun
    louder = causes(made, closures=[left._replace(unsure=unsure, after=0.0137)], seen=seen)
    assert verdict_of(examination(), louder).name == "effect"
    # one that explains nearly all of it is right, though tests of the samples seen cannot tell its numbers so well
    most = causes(made, closures=[left._replace(unsure=unsure, recalibrated=0.1)], seen=seen)
    assert verdict_of(examination(), most).name == "effect"


def test_what_hardly_shrinks_the_gap_explains_nothing_though_noise_took_up_the_rest(monkeypatch):
    monkeypatch.setattr("jaxsid.gap.verdict._beside", lambda found: 0)
    idle = closure(0.99 * 0.3, floor=0.99 * 0.3)
    assert idle.against_recalibrated == 1.0
    found = causes(ranking(0.0, -200.0), closures=[idle])
    assert verdict_of(examination(), found).name == "effect"  # all of it noise, as far as tests can tell
    guess, told = (Noise(np.ones(3), np.ones((3, 1)), degrees, "residual") for degrees in (0.0, 500.0))
    before, most, less = (null.Null(0.0, share, (), ()) for share in (0.1, 0.06, 0.04))
    gap = examination()._replace(null=before)
    somewhere = found._replace(places=SimpleNamespace(), noises=(guess,), remaining=most)
    left, verdict = concluded(gap, somewhere)
    assert verdict.name == "unknown"
    assert left.selected == ()
    # friction of a free axis hardly shows in windows, any law in loud noise: that tests find less tells
    assert verdict_of(gap, somewhere._replace(remaining=less)).name == "effect"
    # noise that is known takes up nothing
    known = somewhere._replace(noises=(told,))
    assert verdict_of(gap, known).probability["unknown"] == pytest.approx(REMAINDER, abs=5e-3)


def test_ambiguous_names_as_many_as_have_nine_tenths():
    level = [TEMPERATURE * math.log(p) for p in (0.5, 0.3, 0.15, 0.05)]
    found = verdict_of(examination(), causes(ranking(*level), closures=[closure(0.012)]))
    assert found.name == "ambiguous"
    assert [x.kind for x in found.likely[0]] == ["cubic_stiffness", "backlash", "end_stop"]
    assert found.likely[0][0].probability == pytest.approx(0.5, abs=1e-6)


def test_one_doubtful_effect_of_two_makes_it_ambiguous():
    there = [("hysteresis", B23), ("backlash", B23)]
    sure, open_one = ranking(0.0, -500.0), ranking(0.0, -5.0, kinds=there)
    refused = ranking(0.0, -1.0)
    given = [closure(0.1), closure(0.012)]
    found = verdict_of(examination(), causes(sure, open_one, refused, closures=given))
    assert found.name == "ambiguous"
    assert [len(x) for x in found.likely] == [1, 2]
    again = verdict_of(
        examination(), causes(sure, ranking(0.0, -500.0, kinds=there), open_one, closures=given)
    )
    assert again.name == "effect"


def test_unknown_is_what_leaves_most_of_the_gap_of_the_best_linear_model():
    found = verdict_of(examination(), causes(ranking(0.0, -500.0), closures=[closure(0.2)]))
    assert found.name == "unknown"
    # what is in the catalogue is missed at times, as what is not is at times taken for it
    assert found.probability["unknown"] == pytest.approx(1 - MISSED, abs=5e-3)
    # what counts is the last closure
    there = ranking(0.0, -500.0, kinds=[("hysteresis", B23), ("backlash", B23)])
    two = causes(ranking(0.0, -500.0), there, closures=[closure(0.2), closure(0.02)])
    assert verdict_of(examination(), two).name == "effect"
    # where more than noise is left of what no linear model explains, more must be gone
    with_floor = lambda gap, floor: math.hypot(0.3 * gap, floor)  # noqa: E731
    much, some, little = (
        closure(with_floor(0.3, x), recalibrated=with_floor(1.0, x), floor=x) for x in (0.01, 0.1, 0.25)
    )
    structure = examination(finding="structure")
    for one, name in ((much, "unknown"), (some, "unknown"), (little, "effect")):
        assert one.against_recalibrated == pytest.approx(0.7)
        there = causes(ranking(0.0, -500.0), closures=[one])._replace(places=SimpleNamespace())
        assert verdict_of(structure, there).name == name
    most = closure(with_floor(0.1, 0.01), recalibrated=with_floor(1.0, 0.01), floor=0.01)
    assert most.against_recalibrated == pytest.approx(0.9)
    assert verdict_of(structure, causes(ranking(0.0, -500.0), closures=[most])).name == "effect"
    # where the best linear model leaves noise, what counts is the gap of the nominal one
    linear = closure(0.0101, recalibrated=0.0102)
    assert linear.against_recalibrated < 0.5
    assert verdict_of(examination(), causes(ranking(0.0), closures=[linear])).name == "effect"
    # and where tests of the samples seen find no more than that model explains, whatever it leaves of others
    beyond = causes(ranking(0.0), closures=[closure(0.025, recalibrated=0.03)])
    assert verdict_of(examination(finding="structure"), beyond).name == "unknown"
    assert verdict_of(examination(finding="parameters"), beyond).name == "effect"
    little = causes(ranking(0.0), closures=[closure(0.25, recalibrated=0.26)])
    assert verdict_of(examination(finding="parameters"), little).name == "unknown"


@pytest.mark.parametrize(
    ("left_at", "gaps", "kept"),
    [
        (Place("between", ("b2", "b3")), (0.1, 0.09), 1),  # the second stands in for what is there
        (Place("between", ("b3", "b1")), (0.1, 0.09), 1),  # and the second explains little of what was left
        (Place("between", ("b3", "b1")), (0.14, 0.06), 2),
        (Place("between", ("b2", "b1")), (0.1, 0.09), 0),
        (Place("sensor", ("s1",)), (0.2, 0.09), 0),
        (None, (0.1, 0.09), 0),
    ],
)
def test_a_stand_in_for_an_unknown_law_is_not_selected(monkeypatch, left_at, gaps, kept):
    monkeypatch.setattr("jaxsid.gap.verdict.verdict_of", lambda *_: Verdict("unknown", {}, ((), ())))
    monkeypatch.setattr("jaxsid.gap.verdict.located", lambda x: SimpleNamespace(likely=(x,)))
    here, there = ranking(0.0, kinds=[("backlash", B12)]), ranking(0.0, kinds=[("hysteresis", B23)])
    found = causes(here, there, closures=[closure(x) for x in gaps])._replace(places=left_at)
    left, verdict = concluded(examination(), found)
    assert [x.kind for x in left.selected] == ["backlash", "hysteresis"][:kept]
    assert len(verdict.likely) == kept
    # model, closure and what is left are of one hypothesis
    assert len(left.closures) == len(left.lefts) == max(kept, 1)
    assert left.chosen is (found.selected[kept - 1].refit if kept else found.recalibrated)
    assert left.closures[-1] is (found.closures[kept - 1] if kept else found.linear)
    assert left.lefts[-1] is (found.lefts[kept - 1] if kept else found.before[1])


def test_a_verdict_other_than_unknown_leaves_all_causes():
    found = causes(ranking(0.0, -200.0), closures=[closure(0.012)])
    assert concluded(examination(), found)[0] is found


# offsets and records without noise


def test_two_springs_at_one_place_imitate_one_of_another_shape():
    def said(*found):
        rounds = [ranking(0.0, -500.0, kinds=[x, ("hysteresis", B23)]) for x in found]
        return verdict_of(examination(), causes(*rounds, closures=[closure(0.05), closure(0.0101)]))

    both = said(("end_stop", B12), ("cubic_stiffness", {"between": ("b2", "b1")}))
    assert both.name == "unknown"
    assert both.probability["unknown"] == IMITATED
    assert [x.kind for x in both.imitating] == ["end_stop", "cubic_stiffness"]
    assert said(("cogging_ripple", B12), ("end_stop", B12)).name == "unknown"
    # a polynomial, other places, other laws
    assert said(("quadratic_stiffness", B12), ("cubic_stiffness", B12)).name == "effect"
    assert said(("end_stop", B12), ("cubic_stiffness", B23)).name == "effect"
    assert said(("coulomb_friction", B12), ("cubic_stiffness", B12)).imitating == ()


@pytest.mark.parametrize("places", [None, SimpleNamespace()])
def test_a_loop_beside_a_spring_is_no_curve(places):
    rounds = [ranking(0.0, -500.0, kinds=[(x, B12), ("hysteresis", B23)]) for x in ("backlash", "hysteresis")]
    tried = causes(*rounds, closures=[closure(0.05), closure(0.0101)])
    verdict = verdict_of(examination(), tried._replace(places=places))
    assert verdict.name == "effect"
    assert verdict.imitating == ()
    assert [x.kind for x in verdict.paired] == ["backlash", "hysteresis"]


def test_two_laws_at_one_place_are_less_sure_than_at_two():
    def unknown(*found):
        rounds = [ranking(0.0, -500.0, kinds=[x, ("hysteresis", B23)]) for x in found]
        verdict = verdict_of(examination(), causes(*rounds, closures=[closure(0.05), closure(0.0101)]))
        assert verdict.name == "effect"
        return verdict.probability["unknown"]

    friction = ("coulomb_friction", B12)
    assert unknown(friction, ("cubic_stiffness", {"between": ("b2", "b1")})) == TWOFOLD
    # another place, a polynomial, numbers of the model
    assert unknown(friction, ("cubic_stiffness", B23)) < 2 * LAPSE
    assert unknown(friction, ("damping_error", B12)) < 2 * LAPSE
    assert unknown(("quadratic_stiffness", B12), ("cubic_stiffness", B12)) < 2 * LAPSE


def test_doubt_of_an_effect_has_a_reason():
    said = lambda found: about_doubt(found, verdict_of(examination(), found))  # noqa: E731
    kinds = ("coulomb_friction", "cubic_stiffness")
    rounds = [ranking(0.0, -500.0, kinds=[(k, B12), ("hysteresis", B23)]) for k in kinds]
    (pair,) = said(causes(*rounds, closures=[closure(0.05), closure(0.0101)]))
    assert "probability of 0.40" in pair
    assert "coulomb friction and cubic stiffness between b1 and b2" in pair
    load, friction = ("constant_load", {"body": "b1"}), ("coulomb_friction", {"between": ("ground", "b1")})
    rounds = [ranking(0.0, -500.0, kinds=[x, ("hysteresis", B23)]) for x in (load, friction)]
    (pair,) = said(causes(*rounds, closures=[closure(0.05), closure(0.0101)]))
    assert "constant load and coulomb friction between ground and b1" in pair
    (rest,) = said(causes(ranking(0.0, -200.0), closures=[closure(0.035)]))
    assert "leaves 3.5 % on samples that were not used" in rest
    assert "linear model leaves 30 % and noise alone 1 %" in rest
    # nothing to explain: sure of it, or unknown, which the summary says
    assert said(causes(ranking(0.0, -200.0), closures=[closure(0.0101)])) == []
    assert said(causes(ranking(0.0, -200.0), closures=[closure(0.25)])) == []
    assert about_doubt(None, verdict_of(examination(0.4, 0.6), None)) == []


def test_springs_of_the_catalogue_are_curves_over_the_displacement():
    springs = [k for k in CATALOGUE.values() if k.restoring and not k.states]
    assert len(springs) >= 5
    d = jnp.linspace(-3.0, 3.0, 9)
    at = lambda v, t: Motion(d, *(x + 0 * d for x in (v, 0.0, t, 3.0)))  # noqa: E731
    for kind in springs:
        numbers = [jnp.asarray(0.4 + 0.1 * i) for i in range(len(kind.parameters))]
        force = kind.force(at(0.1, 0.0), *numbers)
        np.testing.assert_array_equal(force, kind.force(at(-7.0, 5.0), *numbers))
        assert np.abs(np.diff(force, n=2)).max() > 0.01  # and none is straight
