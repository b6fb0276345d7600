"""Before and after, parameters with error bars and correlation, residual analysis: what the report says of each."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from report_fixture import identification, with_elements, without_matrices

from jaxsid.pipeline.correlations import correlations
from jaxsid.pipeline.misses import cross_peaks, own_peaks
from jaxsid.report import plots
from jaxsid.report.findings import UNREFINED, fit_section, matrices_section
from jaxsid.report.frame import Gallery, Notice, Table, Text
from jaxsid.report.identification_page import report_page
from jaxsid.report.parameters import correlation_words, parameters_section, strongest_pairs, value_names
from jaxsid.report.residuals import residual_section
from jaxsid.report.results import identification_json


@pytest.fixture(scope="module")
def found():
    return identification()


@pytest.fixture(scope="module")
def fitted(found):
    """Elements, of which the errors of two springs go against each other."""
    values = with_elements(found).elements
    rho = np.eye(9)
    rho[6, 7] = rho[7, 6] = -0.93
    rho[0, 8] = rho[8, 0] = 0.61
    rho[3] = rho[:, 3] = np.nan
    values = dataclasses.replace(
        values, values=jnp.asarray(values.values).at[1].set(3.9), correlation=jnp.asarray(rho)
    )
    return dataclasses.replace(found, elements=values)


def table(section):
    return next(b for b in section.blocks if isinstance(b, Table))


def texts(row):
    return [c if isinstance(c, str) else c.text for c in row]


def test_before_and_after(found):
    shown = table(fit_section(found))
    assert shown.header[1:5] == ("Nominal model", "CBSI alone", "Refined matrices", "Noise floor")
    first, _, last = map(texts, shown.rows)
    assert first[:2] == ["acc1", "40.0\N{NO-BREAK SPACE}%"]
    cbsi, refined, floor = (float(x[0]) for x in (found.cbsi_nrmse, found.train_nrmse, found.noise_floor))
    shares = [float(x.split("\N{NO-BREAK SPACE}")[0]) for x in first[2:5]]
    assert shares == pytest.approx([100 * cbsi, 100 * refined, 100 * floor], rel=5e-3)
    assert first[5:] == ["1.00", "noise only"]
    assert last[1].startswith("over 10000")
    assert last[5:] == ["3.10", "far above noise"]


def test_before_and_after_where_matrices_do_not_explain_the_records(found):
    poor = dataclasses.replace(found, matrices_nrmse=5 * found.matrices_nrmse)
    shown = table(fit_section(poor))
    assert shown.header[3:5] == ("Refined matrices", "State-space model")
    assert texts(shown.rows[0])[6] == "1.00"  # of the model that is reported
    bare = table(fit_section(without_matrices(found)))
    assert bare.header[:4] == ("Sensor", "Nominal model", "State-space model", "Noise floor")


def test_parameters_with_deviations_and_changes_in_them(fitted):
    shown = table(parameters_section(fitted))
    rows = {texts(row)[0]: row for row in shown.rows}
    assert list(rows)[:4] == ["base mass", "middle mass", "top mass", "spring1 damping"]
    assert texts(rows["base mass"])[1:] == ["5.0000", "5.100", "0.020", "+2.0 %", "+5"]
    assert rows["base mass"][2].small == "kg"
    assert rows["base mass"][5].tone == "warning"
    assert texts(rows["middle mass"])[4:] == ["\N{MINUS SIGN}2.5 %", "\N{MINUS SIGN}6.25"]
    open_one = rows["spring1 damping"]
    assert open_one[3].small == "not determined"
    assert texts(open_one)[5] == "\N{EN DASH}"
    assert open_one[0].small == "ground \N{EN DASH} base"


def test_errors_that_go_together_are_named(fitted):
    values, names = fitted.elements, value_names(fitted.elements, fitted.nominal)
    assert [(i, j, round(r, 2)) for i, j, r in strongest_pairs(values)] == [(7, 6, -0.93), (8, 0, 0.61)]
    words = correlation_words(values, names)
    assert "spring1 stiffness and spring2 stiffness (\N{MINUS SIGN}0.93)" in words
    assert "base mass and spring3 stiffness (+0.61)" in words
    assert any(isinstance(b, Text) and b.text == words for b in parameters_section(fitted).blocks)
    alone = with_elements(identification()).elements
    assert "each value stands on its own" in correlation_words(alone, names)


def test_the_pictures_of_parameters(fitted):
    names = value_names(fitted.elements, fitted.nominal)
    every = np.arange(9)
    moved, certain = plots.parameter_figure(fitted.elements, names, every).axes
    (points,) = (x for x in moved.lines if len(x.get_xdata()) == 9 and x.get_marker() == "o")
    np.testing.assert_allclose(points.get_xdata(), [2, -2.5, 2, 2, 2, 2, 2, 2, 2])
    (bars,) = moved.collections
    np.testing.assert_allclose(bars.get_segments()[0][:, 0], [2 - 0.8, 2 + 0.8])
    assert [x.get_text() for x in moved.texts] == list(names)
    np.testing.assert_allclose(certain.lines[0].get_xdata()[0], 100 * 0.02 / 5.1)
    kept = np.array([0, 6, 7, 8])
    figure = plots.correlation_figure(fitted.elements, names, kept)
    shown = np.asarray(figure.axes[0].images[0].get_array())
    np.testing.assert_array_equal(shown, np.asarray(fitted.elements.correlation)[np.ix_(kept, kept)])
    assert [x.get_text() for x in figure.axes[0].texts][8:] == ["\N{MINUS SIGN}0.93", "0.61"]
    (gallery,) = (b for b in parameters_section(fitted).blocks if isinstance(b, Gallery))
    assert len(gallery.pictures) == 2


def test_many_values_show_the_least_certain_and_the_most_tied(fitted):
    """Forty values: figures keep to twenty-four, the tables show all."""
    count = 40
    one = fitted.elements
    rho = np.eye(count)
    rho[38, 39] = rho[39, 38] = 0.99
    many = dataclasses.replace(
        one,
        listed=tuple(one.listed[i % 9]._replace(element=f"e{i}") for i in range(count)),
        values=jnp.ones(count),
        deviation=jnp.linspace(0.001, 0.1, count),
        correlation=jnp.asarray(rho),
        nominal=jnp.ones(count),
    )
    section = parameters_section(dataclasses.replace(fitted, elements=many))
    assert len(table(section).rows) == count
    (gallery,) = (b for b in section.blocks if isinstance(b, Gallery))
    moved, together = (x.svg for x in gallery.pictures)
    assert ">e39 " in moved
    assert ">e10 " not in moved
    assert ">e38 " in together


def test_a_spring_that_the_model_does_not_have_is_no_parameter(fitted):
    one = fitted.elements
    none = dataclasses.replace(
        one,
        values=one.values.at[6:8].set(0.0),
        nominal=one.nominal.at[6].set(0.0),
        deviation=one.deviation.at[6:8].set(0.0),
    )
    rows = {
        texts(r)[0]: r for r in table(parameters_section(dataclasses.replace(fitted, elements=none))).rows
    }
    assert "spring1 stiffness" not in rows
    assert rows["spring2 stiffness"][3].small == "held at a bound"  # it had one: a fit that would be negative


def test_entries_stand_in_for_elements(fitted):
    section = parameters_section(dataclasses.replace(fitted, elements=None, entries=fitted.elements))
    assert "largest entries" in section.blocks[0].text
    assert parameters_section(dataclasses.replace(fitted, elements=None)).blocks == ()


def test_without_refinement_it_says_so(found):
    plain = dataclasses.replace(found, refined=False, matrices_std=None, matrices_nrmse=None)
    assert matrices_section(plain).blocks[0] == Text(UNREFINED)
    assert "±" not in "".join(c.text for t in matrices_section(plain).blocks[1].tables for c in t.rows[0][1:])
    assert "Parameters" not in report_page(plain)


def following(found):
    """The same with a trace of the force, five samples late, in the second sensor, and colour in the third."""
    (record,) = found.records
    e = np.array(record.y - found.predictions[0])
    u = np.asarray(record.u)[:, 0]
    e[:, 1] += 0.5 * e[:, 1].std() / u.std() * np.roll(u, 5)
    e[:, 2] = np.convolve(e[:, 2], [1, 1, 1, 1], "same")
    left = correlations(e, np.asarray(record.u), float(record.dt))
    return dataclasses.replace(found, residuals=(left,)), left


def test_residuals_that_are_noise(found):
    section = residual_section(found)
    notice = section.blocks[0]
    assert isinstance(notice, Notice)
    assert notice.tone == "good"
    assert "independent of the inputs" in notice.messages[0]
    assert "white" in notice.messages[1]
    for row in table(section).rows:
        assert texts(row)[2] == texts(row)[4] == "yes"


def test_residuals_that_follow_an_input_or_are_coloured(found):
    bad, left = following(found)
    section = residual_section(bad)
    notice = section.blocks[0]
    assert notice.tone == "warning"
    assert "What is left of acc2 follows the inputs" in notice.messages[0]
    assert "not white at acc3" in notice.messages[1]
    rows = {texts(row)[0]: row for row in table(section).rows}
    assert texts(rows["acc2"])[4] == "no"
    assert texts(rows["acc1"])[4] == texts(rows["acc3"])[4] == "yes"
    assert texts(rows["acc3"])[2] == "no"
    value = float(np.asarray(left.cross_correlation)[np.asarray(left.cross_lags).searchsorted(0) + 5, 1, 0])
    assert texts(rows["acc2"])[3] == f"{value:.3f}"
    assert rows["acc2"][3].small.startswith("force, 0.025 s")
    # what is left is next to nothing: rounding
    tiny = dataclasses.replace(bad, train_nrmse=1e-7 * bad.train_nrmse)
    assert residual_section(tiny).blocks[0].tone == "good"


def test_the_picture_of_residuals(found):
    bad, left = following(found)
    own, crossed = plots.residual_figure(bad, ("acc1", "acc2")).axes
    curves = {line.get_label(): np.asarray(line.get_ydata()) for line in own.lines}
    np.testing.assert_array_equal(curves["acc2"], np.asarray(left.autocorrelation)[1:, 1])
    assert {"acc1", "acc2"} <= set(curves)
    assert sum(np.allclose(y, left.white_limit) for y in curves.values()) <= 2
    curves = {line.get_label(): np.asarray(line.get_ydata()) for line in crossed.lines}
    over = np.asarray(left.cross_correlation)[:, 1, 0] / float(left.cross_limit[1, 0])
    np.testing.assert_array_equal(curves["acc2, force"], over)


def test_residuals_of_an_absent_sensor_and_of_none(found):
    (left,) = found.residuals
    gone = dataclasses.replace(
        left,
        autocorrelation=left.autocorrelation.at[:, 0].set(jnp.nan),
        cross_correlation=left.cross_correlation.at[:, 0].set(jnp.nan),
        cross_limit=left.cross_limit.at[0].set(jnp.nan),
    )
    section = residual_section(dataclasses.replace(found, residuals=(gone,)))
    assert [texts(row)[0] for row in table(section).rows] == ["acc2", "acc3"]
    none = dataclasses.replace(found, residuals=())
    assert residual_section(none).blocks == ()
    assert identification_json(none)["residuals"] == []


def test_json_of_comparison_correlation_and_residuals(fitted):
    bad, _ = following(fitted)
    data = identification_json(bad)
    assert data["fit"]["nominal_nrmse"]["acc1"] == 0.4
    assert data["fit"]["cbsi_nrmse"]["acc2"] == float(fitted.cbsi_nrmse[1])
    assert data["refined"] is True
    assert data["correlation"]["names"][6:8] == ["spring1.stiffness", "spring2.stiffness"]
    assert data["correlation"]["values"][6][7] == -0.93
    assert data["correlation"]["values"][3][3] is None
    (record,) = data["residuals"]
    assert record["record"] == "sweep.csv"
    (crossed,), (own,) = cross_peaks(bad.residuals), own_peaks(bad.residuals)
    told = record["sensors"]["acc2"]["inputs"]["force"]
    assert told == {
        "value": float(crossed.value[1, 0]),
        "lag_s": pytest.approx(0.025),
        "score": float(crossed.score[1, 0]),
        "limit": crossed.limit,
        "by_chance": False,
    }
    assert record["sensors"]["acc3"]["autocorrelation"]["value"] == float(own.value[2])
    assert record["sensors"]["acc1"]["autocorrelation"]["by_chance"] is True
    bare = identification_json(without_matrices(identification()))
    assert bare["fit"]["cbsi_nrmse"] is bare["fit"]["matrices_nrmse"] is bare["correlation"] is None
