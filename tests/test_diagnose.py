"""The diagnosis as a value, as JSON, as a page and as a command."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import DT, JOINT, SAMPLES, chain, drive, exact, noisy, record, with_effect
from typer.testing import CliRunner

from jaxsid import Effect, InputError, Record, diagnose, read_model, write_model
from jaxsid.cli import app
from jaxsid.digits import with_std
from jaxsid.files.results_json import plain
from jaxsid.gap import diagnose as module
from jaxsid.gap.explain import element_place
from jaxsid.gap.places import Place
from jaxsid.gap.verdict import LAPSE
from jaxsid.mechanics.lumped import Input, Matrices, Sensor, lumped_model
from jaxsid.physical.elements import Element, element_matrices
from jaxsid.report.diagnosis_page import diagnosis_page
from jaxsid.report.diagnosis_summary import print_diagnosis
from jaxsid.report.plots.places import map_figure

LAW = {"kind": "cubic_stiffness", "place": {"between": ["b1", "b2"]}}
COEFFICIENT, HELD = 1e6, 3 * SAMPLES // 4


@pytest.fixture(scope="module")
def cubic():
    u = drive()
    y = noisy(with_effect(u, "cubic_stiffness", JOINT, {"coefficient": COEFFICIENT}))
    said = []
    found = diagnose(chain(), record(u, y, name="run-1.csv"), progress=said.append)
    stages = ["noise", "is the gap real", "how large it is", "where it arises", "kinds of effects"]
    assert all(x.startswith(stage) for x, stage in zip(said, stages, strict=False))
    assert "cubic_stiffness at b1 - b2, thoroughly" in said
    assert said[-2:] == ["what is left", "how far the gap shrinks"]
    return found


@pytest.fixture(scope="module")
def written(cubic):
    return json.loads(json.dumps(plain(cubic.as_dict(), "diagnosis")))


def test_a_missing_law_is_named_with_its_place_and_coefficient(cubic, written):
    assert cubic.verdict == written["verdict"] == "effect"
    assert written["finding"] == "structure"
    (selected,) = written["selected"]
    assert {key: selected[key] for key in LAW} == LAW
    assert set(selected["parameters"]) == {"coefficient"}
    coefficient = selected["parameters"]["coefficient"]
    assert abs(coefficient["value"] / COEFFICIENT - 1) < 0.01
    assert abs(coefficient["value"] - COEFFICIENT) < 3 * coefficient["std"]
    assert 1e-4 < coefficient["std"] / COEFFICIENT < 0.01
    (effect,) = cubic.model.effects
    assert (effect.kind, effect.place) == ("cubic_stiffness", (("between", ("b1", "b2")),))
    assert float(effect.parameters["coefficient"]) == coefficient["value"]


def test_probabilities_are_those_of_the_candidates(written):
    assert set(written["verdict_probability"]) == {"none", "effect", "unknown"}
    assert sum(written["verdict_probability"].values()) == pytest.approx(1)
    assert written["verdict_probability"]["effect"] == pytest.approx(1 - LAPSE, abs=5e-3)
    first, *others = written["effects"]
    assert {key: first[key] for key in LAW} == LAW
    assert first["probability"] == pytest.approx(1 - LAPSE, abs=5e-3)
    assert first["confusable_with"] == []
    assert first["parameters"] == written["selected"][0]["parameters"]
    assert len(others) >= 5
    assert sum(x["probability"] for x in written["effects"]) <= 1 + 1e-9
    assert [x["probability"] for x in others] == sorted((x["probability"] for x in others), reverse=True)


def test_the_elements_are_those_of_the_improved_model(cubic, written):
    of = np.asarray(element_matrices(cubic.model).nominal)
    given = {x["name"]: x for x in written["elements"]}
    assert [x["value"] for x in written["elements"]] == pytest.approx(of, rel=1e-12)
    # a cubic spring left out stiffens its connection
    without = given["c2.stiffness"]["value_without_effects"]
    assert abs(without - given["c2.stiffness"]["value"]) > 3 * given["c2.stiffness"]["std"]
    assert without == pytest.approx(float(cubic.examination.refit.stiffness[1]), rel=1e-12)


def test_the_finding_says_numbers_as_the_tables_do(cubic, written):
    told = written["selected"][0]["parameters"]["coefficient"]
    assert f"coefficient {with_std(told['value'], told['std'])} " in cubic.summary[0]


def test_remarks_on_places_are_for_what_no_law_explains(cubic):
    located = cubic.examination.locations._replace(remarks=("of the place",))
    found = cubic.examination._replace(locations=located)

    def shown(verdict):
        judgement = cubic.judgement._replace(name=verdict)
        return "of the place" in module._warnings(
            cubic.nominal, cubic.records, found, cubic.causes, judgement, False
        )

    assert [shown(x) for x in ("effect", "none", "unknown", "ambiguous")] == [False, False, True, True]


def test_the_gap_closes_on_held_out_samples(written):
    closure = written["closure"]
    assert closure["heldout_before"] > closure["heldout_recalibrated"] > 0.1
    assert closure["heldout_after"] < 1.1 * closure["noise_floor"]
    assert closure["noise_floor"] == pytest.approx(0.01, rel=0.1)
    assert closure["fraction"] > 0.95
    assert closure["against_recalibrated"] > 0.9
    low, high = closure["ci95"]
    assert 0.9 < low <= closure["fraction"] <= high <= 1
    assert set(closure["by_sensor"]) == {"s0", "s1", "s2"}
    assert written["selected"][0]["gap_after"] == closure["by_sensor"]
    assert "nothing significant" in written["remaining"]


def test_the_place_and_its_force_are_told_too(written):
    assert written["locations"][0]["place"] == LAW["place"]
    (force,) = [x for x in written["forces"] if x["place"] == LAW["place"]]
    assert force["rms"] > 3 * force["deviation"]
    assert written["gap"]["p_value"] < 1e-6


def test_the_force_is_that_of_the_law(cubic):
    one = next(x for x in cubic.examination.locations.maps if x.place.ends == ("b1", "b2"))
    law = -COEFFICIENT * one.displacement**3
    assert len(law) == HELD  # held-out samples are not looked at
    inside = slice(HELD // 10, -HELD // 10)
    assert np.corrcoef(one.force[inside], law[inside])[0, 1] > 0.97


def test_the_responses_beside_the_record(cubic):
    (beside,) = cubic.examination.beside
    y = np.asarray(cubic.records[0].y)[:HELD]
    np.testing.assert_allclose(beside.measured, y, atol=1e-9 * np.abs(y).max())
    for name, response in (("before", beside.nominal), ("recalibrated", beside.refit)):
        nrmse = np.sqrt(((y - response) ** 2).mean(axis=0)) / y.std(axis=0)
        told = list(getattr(cubic.examination, name).nrmse.values())
        np.testing.assert_allclose(nrmse, told, rtol=1e-6)


def test_the_page(cubic):
    text = diagnosis_page(cubic)
    for said in (
        "Cubic stiffness between b1 and b2",
        "Where it arises",
        "b1 – b2",  # noqa: RUF001
        "Gap over frequency",
        "NRMSE",
    ):
        assert said in text
    assert text.count("<svg") >= 10
    assert "http" not in text.replace("http://www.w3.org", "").replace("https://doi.org", "")


def test_the_map_shows_the_law_as_the_catalogue_counts_it(cubic):
    figure = map_figure(cubic, cubic.examination.locations.maps[0])
    mean = figure.axes[0].lines[1]
    assert np.corrcoef(mean.get_xdata(), mean.get_ydata())[0, 1] > 0.8  # a spring rises to the right


def test_the_summary(cubic, capsys):
    print_diagnosis(cubic)
    told = capsys.readouterr().out
    assert "Cubic stiffness between b1 and b2" in told
    assert "Where it arises" in told


def test_the_summary_says_what_comes_near_an_unknown_law(cubic, monkeypatch):
    (law,) = cubic.causes.selected

    def said(*near):
        judgement = cubic.judgement._replace(name="unknown", imitating=near)
        return cubic._replace(judgement=judgement).summary[0]

    assert said().endswith("Its place is most likely b1 - b2.")
    # of several that are not told apart first that of the law which explains most, which is there
    several = (Place("input", ("f",)), Place("between", ("b1", "b2")))
    apart = cubic.examination._replace(locations=cubic.examination.locations._replace(likely=several))
    unsure = cubic._replace(examination=apart, judgement=cubic.judgement._replace(name="unknown"))
    assert unsure.summary[0].endswith("Its place is most likely b1 - b2; not told from it: input f.")
    assert said(law).endswith("What comes near it is cubic stiffness between b1 and b2.")
    assert "Together, cubic stiffness between b1 and b2 and cubic stiffness" in said(law, law)
    # as it does where the numbers are far off
    far = cubic._replace(
        judgement=cubic.judgement._replace(name="unknown", imitating=(law,)),
        causes=cubic.causes.first(0),
    )
    monkeypatch.setattr(type(cubic.examination), "far_off", True)
    assert "far from these records" in far.summary[0]
    assert far.summary[0].endswith("What comes near it is cubic stiffness between b1 and b2.")


@pytest.mark.slow
def test_wrong_numbers_are_named():
    u = drive()
    found = diagnose(chain(factor=1.05), record(u, noisy(exact(u))))
    assert found.verdict == "effect"
    selected = found.as_dict()["selected"]
    assert {x["kind"] for x in selected} == {"stiffness_error"}
    assert {tuple(x["place"]["between"]) for x in selected} == {("ground", "b1"), ("b1", "b2"), ("b2", "b3")}
    for x in selected:
        factor = x["parameters"]["factor"]
        assert abs(factor["value"] - 1 / 1.05) < 5 * factor["std"]


@pytest.mark.parametrize(
    ("changes", "bodies"),
    [
        # of 0.5 % tolerance, known to 0.05 %: beyond it, within it, and beyond by what is hardly known
        ((0.03, 0.004, 0.0), ["b1"]),
        ((-0.02, 0.03, 0.0), ["b2", "b1"]),
        ((0.004, 0.003, 0.0001), ["b1", "b2"]),
    ],
)
def test_numbers_are_named_that_are_beyond_their_tolerance_farthest_first(changes, bodies):
    listed = element_matrices(chain()).listed
    theta = np.zeros(len(listed))
    for body, change in zip(("b1", "b2", "b3"), changes, strict=True):
        theta[[element_place(chain(), x) for x in listed].index({"body": body})] = change
    fit = SimpleNamespace(theta=theta, covariance=np.eye(len(listed)) * 5e-4**2)
    found = SimpleNamespace(
        causes=SimpleNamespace(chosen=SimpleNamespace(fit=fit)),
        closure=SimpleNamespace(by_sensor={}),
        nominal=chain(),
    )
    named = module.Diagnosis._wrong_numbers(found)
    assert [x["place"]["body"] for x in named] == bodies
    assert {x["kind"] for x in named} == {"mass_error"}


@pytest.mark.slow
def test_a_spring_that_the_model_lacks_is_not_taken_for_wrong_numbers():
    """One sensor, whose readings the model's own numbers would give, several of them off by more than they may be."""
    u, lone = drive(), ((0, "acceleration"),)
    y = noisy(with_effect(u, "missing_connection", (0, 2), {"stiffness": 15.0, "damping": 0.0}, lone))
    found = diagnose(chain(lone), record(u, y, lone))
    assert found.examination.finding == "parameters"
    (one,) = found.as_dict()["selected"]
    assert (one["kind"], one["place"]) == ("missing_connection", {"between": ["b1", "b3"]})
    stiffness = one["parameters"]["stiffness"]
    assert abs(stiffness["value"] - 15.0) < 4 * stiffness["std"] < 15.0


def test_places_of_numbers_have_two_ends_or_a_body_for_matrices_too():
    assert element_place(chain(), Element("c1", "damping")) == {"between": ["ground", "b1"]}
    assert element_place(chain(), Element("b2", "mass")) == {"body": "b2"}
    matrices = Matrices(*(jnp.eye(2) + k * jnp.array([[1.0, -1.0], [-1.0, 1.0]]) for k in (0.0, 0.1, 5.0)))
    model = lumped_model(
        ["a", "b"], matrices=matrices, inputs=[Input("f", "a")], sensors=[Sensor("s", "a", "velocity")]
    )
    places = [element_place(model, x) for x in element_matrices(model).listed]
    assert {"body": "a"} in places
    assert {"between": ["a", "b"]} in places
    assert {"between": ["ground", "b"]} in places
    assert all(len(x["between"]) == 2 for x in places if "between" in x)


def test_the_command(tmp_path):
    u = drive()
    y = noisy(exact(u, start=[0.02, 0.0, -0.03, 0.3, 0.0, 0.1]))
    columns = np.column_stack([np.arange(SAMPLES) * DT, u, y])
    np.savetxt(tmp_path / "run.csv", columns, delimiter=",", header="time,drive,s0,s1,s2", comments="")
    write_model(chain(), tmp_path / "model.toml")
    given = [str(tmp_path / x) for x in ("model.toml", "run.csv")]
    done = CliRunner().invoke(app, ["diagnose", *given, "--out", str(tmp_path / "out"), "--initial", "rest"])
    assert done.exit_code == 0, done.output
    assert "agree with the model" in done.output
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert written["schema"] == 1
    assert written["verdict"] == "none"
    assert written["locations"] == []
    assert any("does not start at rest" in x for x in written["warnings"])
    assert read_model(tmp_path / "out" / "model.toml").bodies == ("b1", "b2", "b3")
    assert set(np.load(tmp_path / "out" / "forces.npz")) == set()
    assert "Findings" in (tmp_path / "out" / "report.html").read_text()
    wrong = CliRunner().invoke(
        app, ["diagnose", *given[:1], str(tmp_path / "no.csv"), "--out", str(tmp_path / "b")]
    )
    assert wrong.exit_code == 2
    assert not (tmp_path / "b").exists()


@pytest.mark.slow
def test_what_must_be_known_is_said(monkeypatch):
    monkeypatch.setattr(
        module, "causes_of", lambda *given, **more: None
    )  # warnings do not need it, and it takes long
    u = drive()
    y = -noisy(exact(u))
    friction = Effect("coulomb_friction", (("between", ("ground", "b1")),), {"force": 1.0})
    found = diagnose(chain(effects=[friction]), record(u, y))
    said = " ".join(found.warnings)
    assert "coulomb_friction) were left out" in said
    assert "larger than the signal itself" in said
    few = Record(0 * u[:, None], y[:, :2], DT, inputs=("drive",), outputs=("s0", "s1"), name="quiet.csv")
    said = " ".join(diagnose(chain(), few).warnings)
    assert "quiet.csv: its inputs are zero throughout" in said
    assert "Sensor 's2' is in none of the records" in said
    with pytest.raises(InputError, match="initial 'zero' is unknown"):
        diagnose(chain(), record(u, y), initial="zero")


@pytest.mark.slow
def test_an_unstable_model_is_judged_by_windows():
    u = drive()
    model = lumped_model(
        ["m"],
        matrices=Matrices(*(jnp.array([[x]]) for x in (1.0, 0.5, -4.0))),
        inputs=[Input("drive", "m")],
        sensors=[Sensor("s0", "m", "acceleration")],
    )
    found = diagnose(model, record(u, exact(u)[:, :1], kinds=((0, "acceleration"),)))
    assert found.examination.before.windowed
    assert any("unstable" in x for x in found.warnings)
    assert found.examination.locations is not None
    assert all(np.isfinite(x.force).all() for x in found.examination.locations.maps)
    assert found.causes is not None
    (seconds,) = found.causes.before[0].windows
    told = f"On samples that were not used, in windows of {seconds:.2g} s, the gap falls"
    assert told in found.summary[1]
    assert f"held-out samples, in windows of {seconds:.2g} s (NRMSE)" in diagnosis_page(found)
