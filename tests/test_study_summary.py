"""Bias, spread and their standard errors against numpy and scipy; tables; which level is better."""

import csv
import math

import numpy as np
import pyarrow.parquet as pq
import pytest
import scipy.stats
from study_helpers import NAMES, make, rechunked, run, study

from jaxsid.study.compare import compare_levels
from jaxsid.study.engine import Clock
from jaxsid.study.store import Facts
from jaxsid.study.summary import summarize


def facts(truth, bound):
    return Facts(("mass_1_1",), ("kg",), np.array([truth]), np.array([bound]))


def one_row(x, truth=2.0, bound=0.5):
    return summarize(study().cases[0], facts(truth, bound), np.asarray(x, float)[:, None])[0]


def test_a_row_by_hand():
    row = one_row([1.0, 2.0, 3.0, 6.0, np.nan, np.inf])
    assert (row.count, row.failed, row.kind, row.unit, row.case) == (4, 2, "mass", "kg", 0)
    assert (row.mean, row.bias, row.relative_bias) == (3.0, 1.0, 0.5)
    assert row.std == pytest.approx(math.sqrt(14 / 3), rel=1e-15)
    assert row.rmse == pytest.approx(math.sqrt((1 + 0 + 1 + 16) / 4), rel=1e-15)
    assert (row.q25, row.q50, row.q75) == (1.75, 2.5, 3.75)
    assert row.robust_std == pytest.approx(scipy.stats.norm.ppf(0.75) ** -1 * 1.0, rel=1e-14)
    assert row.std_over_cramer_rao == pytest.approx(row.std / 0.5, rel=1e-15)
    assert row.bias_error == pytest.approx(row.std / 2, rel=1e-15)


def test_rows_against_scipy():
    x = np.random.default_rng(1).standard_t(5, 1000) + 0.3
    row = one_row(x, truth=0.0)
    assert row.std == pytest.approx(np.std(x, ddof=1), rel=1e-13)
    assert row.robust_std == pytest.approx(scipy.stats.median_abs_deviation(x, scale="normal"), rel=1e-9)
    expected = scipy.stats.mstats.mquantiles(x, [0.025, 0.25, 0.5, 0.75, 0.975], alphap=1, betap=1)
    np.testing.assert_allclose([row.q2_5, row.q25, row.q50, row.q75, row.q97_5], expected, rtol=1e-13)
    assert math.isnan(row.relative_bias)


@pytest.mark.parametrize("draw", ["standard_normal", "standard_exponential"])
def test_standard_errors_are_the_scatter_over_many_studies(draw):
    rng = np.random.default_rng(2)
    rows = [one_row(getattr(rng, draw)(400), truth=0.5) for _ in range(600)]
    for value, error in (("bias", "bias_error"), ("std", "std_error"), ("rmse", "rmse_error")):
        scatter = np.std([getattr(row, value) for row in rows], ddof=1)
        claimed = np.sqrt(np.mean([getattr(row, error) ** 2 for row in rows]))
        assert claimed == pytest.approx(scatter, rel=0.12)


@pytest.mark.parametrize("x", [[], [np.nan, np.inf], [3.0], [2.0, 2.0]])
def test_few_or_equal_values_warn_of_nothing(x):
    row = one_row(x)
    finite = np.isfinite(x)
    assert row.count == finite.sum()
    assert row.failed == len(x) - row.count
    assert math.isnan(row.mean) == (row.count == 0)
    assert math.isnan(row.std) == (row.count < 2)


def test_tables_hold_every_number(tmp_path):
    plan = study(60)
    rows = run(plan, tmp_path)
    table = pq.read_table(tmp_path / "results.parquet")
    assert table.column_names == ["case", "noise", "algorithm", "rows", "number", "quantity", "value"]
    assert table.num_rows == 4 * 60 * 3
    frame = table.to_pandas()
    assert set(frame.select_dtypes("float").columns) == {"noise", "value"}
    for row in rows:
        x = frame[(frame.case == row.case) & (frame.quantity == row.quantity)]
        assert list(x.number) == list(range(60))
        assert set(x.noise) == {row.factors["noise"]}
        good = x.value[np.isfinite(x.value)].to_numpy()
        assert (len(good), 60 - len(good)) == (row.count, row.failed)
        assert row.mean == good.mean()
        assert row.truth == make(plan.cases[0]).truth[NAMES.index(row.quantity)]
    assert 0 < sum(row.failed for row in rows if row.quantity == "mass_1_1") < 60
    assert sum(row.failed for row in rows if row.quantity != "mass_1_1") == 0
    summary = pq.read_table(tmp_path / "summary.parquet").to_pylist()
    with (tmp_path / "summary.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == len(summary) == len(rows) == 12
    for row, line, entry in zip(rows, lines, summary, strict=True):
        assert entry["noise"] == row.factors["noise"]
        for name in ("truth", "std", "rmse", "q97_5", "cramer_rao", "rmse_error"):
            assert float(line[name]) == entry[name] == getattr(row, name)


def test_mixed_factors_become_text(tmp_path):
    plan = study(16)
    for case, order in zip(plan.cases, ("true", 4, 6, "true+2"), strict=True):
        case.values["order"] = order
    run(plan, tmp_path)
    table = pq.read_table(tmp_path / "summary.parquet").to_pandas()
    assert list(table.order[::3]) == ["true", "4", "6", "true+2"]


def compared(rows, varied):
    return {(entry.factor, entry.level): entry for entry in compare_levels(rows, varied)}


def test_levels_are_compared_where_nothing_else_differs(tmp_path):
    plan = study(400)
    rows = run(plan, tmp_path)
    found = compared(rows, plan.varied)
    entry = found["noise", 0.1]
    assert (entry.best, entry.pairs, entry.worse, entry.better) == (0.01, 6, 6, 0)
    logs = [
        math.log(b.rmse / a.rmse) for a, b in zip(rows, rows[3:], strict=False) if a.factors["noise"] == 0.01
    ]
    assert entry.ratio == pytest.approx(math.exp(np.mean(logs[:3] + logs[3:])), rel=1e-12)
    (other,) = [entry for key, entry in found.items() if key[0] == "algorithm"]
    assert other.pairs == 6
    assert (other.worse, other.better) == (0, 0)  # it has no effect
    assert 1 <= other.ratio < 1.1
    assert compare_levels(rows, ("rows",)) == []


def test_other_truths_and_random_sweeps_are_not_compared():
    cases = study().cases
    x = np.random.default_rng(0).normal(2, 0.1, (100, 1))
    rows = [
        r
        for case, truth in zip(cases[:2], (2.0, 2.5), strict=True)
        for r in summarize(case, facts(truth, 1), x)
    ]
    assert compare_levels(rows, ("noise",)) == []
    rows = [r for case in (cases[0], cases[3]) for r in summarize(case, facts(2.0, 1), x)]
    assert compare_levels(rows, ("noise", "algorithm")) == []


def test_the_clock_tells_the_remaining_time_from_recent_chunks():
    now = [0.0]
    clock = Clock(1000, 200, lambda: now[0])
    assert clock.step(0) == (200, 1000, None)
    now[0] = 50.0  # the first chunk also compiles
    assert clock.step(10).seconds_left == pytest.approx(79 * 50.0)
    for _ in range(40):
        now[0] += 1.0
        left = clock.step(10)
    assert left.done == 610
    assert left.seconds_left == pytest.approx(39.0)


def test_chunk_is_no_part_of_what_decides(tmp_path):
    assert rechunked(study(), chunk=48).source == study().source
