"""The second half of the report of a diagnosis: effects, fitted law, before and after, closure."""

import re
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest
from gap_helpers import DT, JOINT, SAMPLES, chain, drive, noisy, record, with_effect

from jaxsid import Effect, diagnose
from jaxsid.digits import share_of
from jaxsid.gap.force_map import ForceMap
from jaxsid.gap.noise import Noise
from jaxsid.gap.places import Place
from jaxsid.gap.verdict import LAPSE
from jaxsid.report.causes_page import closure_cards, closure_section, numbers_section, which_section
from jaxsid.report.diagnosis_page import diagnosis_page
from jaxsid.report.diagnosis_summary import print_diagnosis
from jaxsid.report.law import law_along
from jaxsid.report.plots.causes import (
    before_after_figure,
    density,
    held_out,
    held_out_pairs,
    spectra_figure,
)
from jaxsid.report.plots.places import map_figure

# the page as a whole is looked at by the quick tests of the diagnosis
pytestmark = pytest.mark.slow

COEFFICIENT = 1e6


@pytest.fixture(scope="module")
def cubic():
    u = drive()
    y = noisy(with_effect(u, "cubic_stiffness", JOINT, {"coefficient": COEFFICIENT}))
    return diagnose(chain(), record(u, y, name="run-1.csv"))


def test_the_page_tells_the_story_in_order(cubic):
    text = diagnosis_page(cubic)
    titles = (
        "Findings",
        "How large it is",
        "Where it arises",
        "Which effect",
        "The force there",
        "Before and after",
        "How far it shrinks",
        "What remains",
        "The model&#39;s numbers",
        "How this was found",
    )
    at = [text.index(f"<h2>{title}</h2>") for title in titles]
    assert at == sorted(at)
    assert text.count("<svg") >= 12
    assert "http" not in text.replace("http://www.w3.org", "").replace("https://doi.org", "")


def test_the_cards_hold_the_gap_before_and_after(cubic):
    before, after, noise, probability = closure_cards(cubic)
    assert before.value.startswith(f"{100 * cubic.closure.before:.1f}")
    assert float(after.value.split()[0]) < 1.3 * float(noise.value.split()[0])
    assert probability.value == share_of(1 - LAPSE)


def test_where_the_noise_is_a_bound_the_cards_say_so(cubic):
    _, plain, _, _ = closure_cards(cubic)
    guess = tuple(Noise(n.level, n.taps, 0.0, "residual") for n in cubic.causes.noises)
    bounded = cubic._replace(causes=cubic.causes._replace(noises=guess, places=SimpleNamespace()))
    _, after, noise, _ = closure_cards(bounded)
    assert noise.value.startswith("at most ")
    assert "of it explained, if noise is as large as it may be" in after.remark
    assert "as it may be" not in plain.remark


def test_the_ranking_names_kind_place_and_parameters(cubic):
    selected, ranking = which_section(cubic).blocks
    (row,) = selected.rows
    assert (row[0].text, row[0].small) == ("cubic stiffness", "between b1 and b2")
    assert row[2].text == "F = p d^3"
    # such as 998765 ± 432 N/m³, or (1.00012 ± 0.00043)·10⁶ N/m³
    size = 1e6 if "10⁶" in row[1].text else 1.0
    value, std = (size * float(x) for x in re.findall(r"[\d.]+", row[1].text)[:2])
    assert abs(value - COEFFICIENT) < 5 * std
    assert (ranking.rows[0][0], ranking.rows[0][2]) == row[:2]
    assert len(ranking.rows) > 1
    effects = cubic.effects()
    assert effects[0]["round"] == 1
    assert effects[0]["left"] < 1.2 < effects[1]["left"]


def test_the_table_of_the_closure_agrees_with_the_closure(cubic):
    (table,) = closure_section(cubic).blocks
    nominal, refitted, chosen, noise = ([float(x.split()[0]) for x in row[1:]] for row in table.rows)
    for row in (nominal, refitted, chosen, noise):
        assert np.sqrt(np.mean(np.square(row[1:]))) == pytest.approx(row[0], rel=0.01)
    assert nominal[0] > refitted[0] > 5 * chosen[0]


def test_the_numbers_are_those_of_the_model_file(cubic):
    (table,) = numbers_section(cubic).blocks
    given = {row[0]: row for row in table.rows}
    stiffness = np.asarray(cubic.model.stiffness)
    for i, value in enumerate(stiffness):
        assert float(given[f"c{i + 1}.stiffness"][2].split(" ±")[0]) == pytest.approx(value, rel=1e-4)


def test_held_out_samples_are_the_last_of_the_record(cubic):
    pairs = held_out_pairs(cubic, 2)
    assert len(pairs) == 2
    sensor, number = pairs[0]
    x = held_out(cubic, sensor, number)
    column = [s.name for s in cubic.nominal.sensors].index(sensor)
    y = np.asarray(cubic.records[0].y)[:, column]
    np.testing.assert_allclose(x.measured, y[-len(x.measured) :])
    assert x.time[0] == pytest.approx((SAMPLES - len(x.measured)) * DT)
    told = np.sqrt(((x.measured - x.chosen) ** 2).mean()) / x.measured.std()
    assert told == pytest.approx(cubic.closure.by_sensor[sensor], rel=1e-6)
    left = before_after_figure(cubic, sensor, number).axes[2]
    assert left.get_xlim()[0] == pytest.approx(x.time[0])


def test_spectra_of_what_is_left_fall_to_the_noise(cubic):
    sensor, number = held_out_pairs(cubic, 1)[0]
    below = spectra_figure(cubic, sensor, number).axes[1]
    nominal, chosen, noise = (np.asarray(line.get_ydata()) for line in below.lines)
    assert nominal.max() > 20 * noise.max()
    assert np.median(chosen) == pytest.approx(np.median(noise), rel=0.25)


def test_density_keeps_the_power():
    y = np.random.default_rng(0).standard_normal(4096)
    f, found = density(y, 0.01)
    assert (found**2).sum() * (f[1] - f[0]) == pytest.approx(y.var(), rel=0.05)


def test_the_fitted_law_lies_on_the_force(cubic):
    force = next(x for x in cubic.examination.locations.maps if x.place.ends == ("b1", "b2"))
    law = law_along(cubic, force)
    np.testing.assert_allclose(law, COEFFICIENT * force.displacement**3, rtol=0.02)
    inside = slice(len(law) // 10, -len(law) // 10)
    assert np.corrcoef(law[inside], -force.force[inside])[0, 1] > 0.97
    drawn = map_figure(cubic, force).axes[0].lines[2]
    assert drawn.get_label() == "law"
    assert drawn.get_linestyle() == "-"  # displacement alone settles it
    assert map_figure(cubic, force).axes[1].lines[2].get_linestyle() == "--"


@pytest.mark.parametrize(
    ("kind", "parameters", "expected"),
    [
        ("coulomb_friction", {"force": 2.0}, lambda d, v, t: 2.0 * np.sign(v)),
        ("backlash", {"half_gap": 1e-3}, lambda d, v, t: -1500.0 * np.clip(d, -1e-3, 1e-3)),
        ("bilinear_stiffness", {"stiffness": 10.0}, lambda d, v, t: 10.0 * np.maximum(d, 0)),
        ("time_varying_stiffness", {"rate": 3.0}, lambda d, v, t: 3.0 * t * d),
        ("missing_connection", {"stiffness": 5.0, "damping": 2.0}, lambda d, v, t: 5 * d + 2 * v),
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_laws_are_counted_at_the_ends_of_the_map(cubic, kind, parameters, expected, turned):
    ends = ("b2", "b1") if turned else ("b1", "b2")
    found = _with_effect(cubic, Effect(kind, (("between", ends),), parameters))
    force = _swing(Place("between", ("b1", "b2")))
    sign = -1 if turned else 1
    motion = sign * force.displacement, sign * force.velocity, force.time
    np.testing.assert_allclose(law_along(found, force), sign * expected(*motion), rtol=1e-6, atol=1e-9)
    assert law_along(found, force._replace(place=Place("between", ("b2", "b3")))) is None


def test_a_memory_is_followed_along_the_motion(cubic):
    parameters = {"stiffness": 100.0, "beta": 0.0, "gamma": 0.0, "exponent": 1.0}
    found = _with_effect(cubic, Effect("hysteresis", (("between", ("b1", "b2")),), parameters))
    force = _swing(Place("between", ("b1", "b2")))
    law = law_along(found, force)
    np.testing.assert_allclose(law, 100.0 * (force.displacement - force.displacement[0]), atol=1e-3)


def test_a_law_far_quicker_than_the_samples_is_followed(cubic):
    """Friction that gives by a thousandth of the swing slides all the time but where it turns round."""
    parameters = {"force": 2.0, "static_force": 3.0, "velocity": 0.005, "stiffness": 1e6}
    found = _with_effect(cubic, Effect("stribeck_friction", (("between", ("b1", "b2")),), parameters))
    force = _swing(Place("between", ("b1", "b2")))
    speed = force.velocity
    sliding = np.sign(speed) * (2.0 + np.exp(-((speed / 0.005) ** 2)))
    law, past = law_along(found, force), (np.abs(speed) > 5e-3) & (force.time > 0.02)
    np.testing.assert_allclose(law[past], sliding[past], atol=0.05)
    assert np.abs(law).max() < 3.0


def test_a_load_on_a_body_opposes_the_force_from_the_ground(cubic):
    found = _with_effect(cubic, Effect("constant_load", (("body", "b1"),), {"force": 3.0}))
    np.testing.assert_allclose(law_along(found, _swing(Place("between", ("ground", "b1")))), -3.0)
    heavier = _with_effect(cubic, Effect("mass_error", (("body", "b1"),), {"factor": 1.2}))
    assert law_along(heavier, _swing(Place("between", ("ground", "b1")))) is None


def test_the_summary_in_the_terminal(cubic, capsys):
    print_diagnosis(cubic)
    told = capsys.readouterr().out
    for said in ("Cubic stiffness between b1 and b2", "the gap falls from", "Which effect", "What remains"):
        assert said in told


def _swing(place):
    t = np.linspace(0, 1, 401)
    motion = 2e-3 * np.sin(9 * t + 0.3), 18e-3 * np.cos(9 * t + 0.3)
    return ForceMap(place, 0, t, np.zeros_like(t), 0.0, *motion)


def _with_effect(found, effect):
    chosen = found.causes.chosen
    model = eqx.tree_at(lambda m: m.effects, chosen.model, (effect,))
    hypothesis = chosen.hypothesis._replace(effects=(effect,), wrong=())
    return found._replace(
        causes=found.causes._replace(chosen=chosen._replace(model=model, hypothesis=hypothesis))
    )
