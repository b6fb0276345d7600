"""The page about a study, its figures, its words; effects in random sweeps."""

import math
import re

import numpy as np
import pytest
from rich.console import Console
from study_helpers import rechunked, run, study
from test_report_page import Reader

from jaxsid.checks import InputError
from jaxsid.digits import percent
from jaxsid.report.study_figures import quantile_figure, spread_figure
from jaxsid.report.study_html import write_study_report
from jaxsid.report.study_layout import Layout, layout, levels, panels
from jaxsid.report.study_page import study_page
from jaxsid.report.study_terminal import left, print_study, study_view
from jaxsid.study.compare import MANY
from jaxsid.study.configuration import Case
from jaxsid.study.effects import estimate_effects
from jaxsid.study.engine import Progress


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    plan = study(200)
    return plan, run(plan, tmp_path_factory.mktemp("grid"))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Thirty cases, each with its own noise; the algorithm has no effect."""
    rng = np.random.default_rng(0)
    values = [
        {"noise": float(10 ** rng.uniform(-3, -1)), "algorithm": "ab"[rng.integers(2)]} for _ in range(30)
    ]
    plan = rechunked(study(200), cases=tuple(Case(i, v) for i, v in enumerate(values)))
    return plan, run(plan, tmp_path_factory.mktemp("sweep"))


def text_of(page):
    reader = Reader(page)
    assert "nan" not in re.sub(r"domi?nan|resonan", "", reader.text)
    assert "script" not in reader.tags
    assert all(address.startswith("#") for address in (*reader.fetched, *reader.links))
    assert len(reader.ids) == len(set(reader.ids))
    return reader.text


def test_the_page_of_a_grid(grid):
    plan, rows = grid
    text = text_of(study_page(plan, rows))
    assert "4 cases of 200 realizations each, seed 3; varied: noise, algorithm" in text
    assert "Noise: 0.01 has the smallest errors. With 0.1 the root mean square error is 10" in text
    assert "no more than chance explains" in text
    assert "Failures: the numbers below hold for what succeeded" in text  # one in ten fails
    assert percent(max(row.failed for row in rows) / 200) in text


@pytest.mark.slow
def test_the_page_of_a_random_sweep(sweep):
    plan, rows = sweep
    text = text_of(study_page(plan, rows))
    power = re.search(r"Noise: all else being equal, errors go with its power ([\d.]+) ± (0\.\d+)", text)
    assert power is not None, text[text.index("Key findings") :][:3000]
    assert abs(float(power[1]) - 1) < 4 * float(power[2]) < 0.05
    assert "errors with b are" in text
    assert "Estimates around the truth" not in text
    assert "30 cases" in text


def test_the_page_of_one_case_and_of_one_where_all_failed(grid):
    plan, rows = grid
    alone = rechunked(plan, cases=plan.cases[:1], varied=())
    assert "varied: nothing" in text_of(study_page(alone, rows[:3]))
    none = [row._replace(count=0, failed=200, **dict.fromkeys(row._fields[7:], math.nan)) for row in rows]
    assert "gave no value" in text_of(study_page(plan, none))


def test_a_factor_that_changes_the_truth_is_not_compared(grid):
    plan, rows = grid
    two = rechunked(plan, varied=("system",))
    moved = [
        row._replace(factors={"system": "ab"[row.case % 2]}, truth=row.truth * (1 + row.case % 2))
        for row in rows[:6]
    ]
    assert "Not compared: system" in text_of(study_page(two, moved))


def test_layouts(grid, sweep):
    assert layout(grid[1], ("noise", "algorithm")) == Layout("noise", "algorithm", ())
    assert layout(grid[1], ("algorithm",)) == Layout("algorithm", None, ())
    assert layout(grid[1], ()) == Layout(None, None, ())
    assert layout(sweep[1], ("noise", "algorithm")) == Layout("noise", "algorithm", ())
    rows = [row._replace(factors={**row.factors, "system": "x", "samples": row.case}) for row in sweep[1]]
    found = layout(rows, ("system", "noise", "samples", "algorithm"))
    assert found == Layout("noise", "algorithm", ("system",))
    assert len(levels(rows, "samples")) > MANY
    assert levels(grid[1], "noise") == [0.01, 0.1]


def test_figures_draw_every_number(grid):
    _, rows = grid
    (panel,) = panels(rows, ())
    figure = spread_figure(panel, "noise", "algorithm")
    axes = figure.axes
    assert [ax.get_title(loc="left") for ax in axes] == ["frequency", "mass"]
    (mass,) = {row.std / row.truth for row in rows if row.case == 0 and row.quantity == "mass_1_1"}
    lines = {line.get_label(): line for line in axes[1].lines}
    assert set(lines) == {"a", "b", "Cramér-Rao"}
    assert lines["a"].get_ydata()[0] == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(lines["Cramér-Rao"].get_ydata(), [0.01, 0.1], rtol=1e-12)
    figure = quantile_figure(panels(rows, ("noise",))[1], "algorithm")
    medians = np.concatenate([line.get_xdata() for line in figure.axes[1].lines if line.get_marker() == "|"])
    expected = [100 * (r.q50 / r.truth - 1) for r in rows if r.factors["noise"] == 0.1 and r.kind == "mass"]
    np.testing.assert_allclose(sorted(medians), sorted(expected), rtol=1e-12)


def test_effects_are_recovered_exactly(grid):
    rng, rows = np.random.default_rng(1), []
    for case in range(24):
        factors = {
            "noise": float(10 ** rng.uniform(-3, -1)),
            "window": "abc"[case % 3],
            "system": "xy"[case % 2],
        }
        size = factors["noise"] ** 1.5 * {"a": 1, "b": 2, "c": 0.5}[factors["window"]]
        for row in grid[1][:3]:
            truth = row.truth * (3 if factors["system"] == "y" else 1)
            scale = 7 * size if factors["system"] == "y" else size
            rows.append(row._replace(case=case, factors=factors, truth=truth, rmse=scale * truth))
    found = {(x.factor, x.level): x for x in estimate_effects(rows, ("noise", "window", "system"))}
    assert set(found) == {("noise", None), ("window", "b"), ("window", "c")}
    for key, value in (
        (("noise", None), 1.5),
        (("window", "b"), math.log(2)),
        (("window", "c"), -math.log(2)),
    ):
        assert found[key].value == pytest.approx(value, rel=1e-10)
        assert found[key].error < 1e-10
    assert estimate_effects(rows[:12], ("noise", "window", "system")) == []  # four cases cannot tell
    twins = [row._replace(factors={**row.factors, "again": row.factors["noise"]}) for row in rows]
    assert estimate_effects(twins, ("noise", "again")) == []


def test_standard_errors_of_effects():
    """Over many sweeps with random errors the estimates scatter as they claim."""
    rng, values, errors = np.random.default_rng(2), [], []
    base = run_one_case()
    for _ in range(200):
        rows = [
            base._replace(case=i, factors={"noise": float(x)}, rmse=float(x * np.exp(0.2 * rng.normal())))
            for i, x in enumerate(10 ** rng.uniform(-3, -1, 20))
        ]
        (effect,) = estimate_effects(rows, ("noise",))
        values.append(effect.value)
        errors.append(effect.error)
    assert np.mean(values) == pytest.approx(1.0, abs=0.015)
    assert np.std(values) == pytest.approx(np.mean(errors), rel=0.2)


def run_one_case():
    from jaxsid.study.store import Facts
    from jaxsid.study.summary import summarize

    facts = Facts(("mass_1_1",), ("kg",), np.ones(1), np.ones(1))
    return summarize(study().cases[0], facts, np.arange(5.0)[:, None])[0]


def test_a_report_needs_its_folder(grid, tmp_path):
    with pytest.raises(InputError, match="no folder"):
        write_study_report(*grid, tmp_path / "missing" / "report.html")


def test_the_terminal(grid, capsys):
    console = Console(width=80, record=True)
    print_study(*grid, console)
    text = console.export_text()
    assert "0 noise 0.01" in text
    assert text.count("%") == 4 * 3
    assert max(map(len, text.splitlines())) <= 80
    for seconds, words in (
        (None, ""),
        (3.2, ", 3 s left"),
        (90, ", 1 min 30 s left"),
        (7300, ", 2 h 1 min left"),
    ):
        assert left(Progress(1, 2, seconds)) == words
    assert left(Progress(2, 2, 5.0)) == ""
    capsys.readouterr()
    with study_view(False) as view:
        view.say("looking")
        for done in (0, 16, 32):
            view.progress(Progress(done, 32, 1.0))
    assert capsys.readouterr().err.splitlines() == [
        "jaxsid: looking ...",
        "jaxsid: 0 of 32 realizations, 1 s left",
        "jaxsid: 32 of 32 realizations",
    ]
