"""The page about a study: which level of each factor estimates better, then figures and tables."""

import math
import statistics
from collections.abc import Sequence

from jaxsid.digits import MISSING, TIMES, percent, plural, significant, with_std
from jaxsid.report.evidence import software
from jaxsid.report.frame import (
    Block,
    Card,
    Cards,
    Cell,
    Gallery,
    Link,
    Links,
    Notice,
    Section,
    Table,
    Text,
    page,
    picture,
)
from jaxsid.report.study_figures import quantile_figure, spread_figure
from jaxsid.report.study_layout import (
    Layout,
    failed_share,
    is_number,
    kinds,
    layout,
    level_text,
    levels,
    named,
    panels,
    pooled,
)
from jaxsid.study.compare import MANY, SIGNIFICANT, Comparison, compare_levels
from jaxsid.study.configuration import Study
from jaxsid.study.effects import Effect, estimate_effects
from jaxsid.study.summary import Row, by_case

SPREAD_FIGURES, QUANTILE_FIGURES = 6, 6
CASES, QUANTITIES = 60, 60  # rows of the tables
FAILING = 0.01  # share of failures worth a warning
REFERENCES = (
    Link("S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, chapter 3 (1993)"),
    Link(
        "J.-N. Juang and R. S. Pappa, Effects of noise on modal parameters identified by the eigensystem realization "
        "algorithm, J. Guidance 9 (1986)"
    ),
)


def study_page(study: Study, rows: Sequence[Row]) -> str:
    """The report as HTML.

    Args:
        study: what was run.
        rows: its summary.
    """
    plan = layout(rows, study.varied)
    sections = (
        _findings(study, rows),
        _spread_section(rows, plan),
        _quantile_section(rows, plan),
        _cases_section(study, rows),
        _quantities_section(study, rows),
        _method_section(),
    )
    subtitle = (
        f"{plural(len(study.cases), 'case')} of {plural(study.realizations, 'realization')} each, seed {study.seed}; "
        f"varied: {', '.join(study.varied) or 'nothing'}"
    )
    return page(
        f"Study: {study.name}", subtitle, sections, f"Made with {software()}. All values in SI units."
    )


def _findings(study: Study, rows: Sequence[Row]) -> Section:
    comparisons = compare_levels(rows, study.varied)
    blocks: list[Block] = [Cards(_cards(study, rows)), _failures(study, rows)]
    blocks += [Text(text) for text in _verdicts(study, rows, comparisons)]
    return Section("Key findings", (*blocks, *([_comparison_table(comparisons)] if comparisons else [])))


def _cards(study: Study, rows: Sequence[Row]) -> tuple[Card, ...]:
    ratios = [r.std_over_cramer_rao for r in rows if math.isfinite(r.std_over_cramer_rao)]
    worst = max(by_case(rows), key=failed_share)
    share = failed_share(worst)
    bound = ("unknown", "no bound for these cases")
    if ratios:
        span = f"from {significant(min(ratios), 2)} to {significant(max(ratios), 2)}; 1 is the best possible"
        bound = (significant(statistics.median(ratios), 3), span)
    return (
        Card("Realizations", str(study.realizations * len(study.cases)), plural(len(study.cases), "case")),
        Card("Summaries", str(len(rows)), "one for each case and quantity, in summary.csv"),
        Card("Spread over the Cramér-Rao bound", bound[0], f"median; {bound[1]}" if ratios else bound[1]),
        Card("Most failures", percent(share), f"case {worst[0].case}" if share else "none failed"),
    )


def _failures(study: Study, rows: Sequence[Row]) -> Notice:
    """The cases that failed most often, or that none did."""
    failing = sorted(by_case(rows), key=failed_share, reverse=True)
    messages = tuple(
        f"Case {case[0].case}{_where(study, case[0])}: {percent(failed_share(case))} of the realizations gave no value."
        for case in failing[:5]
        if failed_share(case) >= FAILING
    )
    if not messages:
        return Notice("In every case at least 99 % of the realizations gave values.", (), "good")
    return Notice("Failures: the numbers below hold for what succeeded", messages)


def _where(study: Study, row: Row) -> str:
    """The varied factors of a row in words."""
    words = ", ".join(named(name, row.factors[name]) for name in study.varied)
    return f" ({words})" if words else ""


def _verdicts(study: Study, rows: Sequence[Row], comparisons: Sequence[Comparison]) -> list[str]:
    """The findings about each factor in plain words; last, those about which there are none."""
    texts, left_out = [], []
    for factor in study.varied:
        found = [entry for entry in comparisons if entry.factor == factor]
        if found:
            best = f"{factor.capitalize()}: {level_text(found[0].best)} has the smallest errors."
            texts.append(" ".join([best, *map(_against, found)]))
        else:
            left_out.append(factor)
    effects = [x for x in estimate_effects(rows, study.varied) if x.factor in left_out]
    silent = [factor for factor in left_out if factor not in {effect.factor for effect in effects}]
    if silent:
        texts.append(
            f"Not compared: {', '.join(silent)}, for no two cases differ in this alone and share the truth."
        )
    return texts + [_effect(effect) for effect in effects]


def _effect(effect: Effect) -> str:
    """What a regression over all cases says about a factor."""
    name, sure = effect.factor.capitalize(), abs(effect.value) > SIGNIFICANT * effect.error
    note = "" if sure else ", no more than chance explains"
    if effect.level is None:
        power = with_std(effect.value, effect.error)
        return f"{name}: all else being equal, errors go with its power {power}{note}."
    assert effect.base is not None
    low, middle, high = (significant(math.exp(effect.value + k * effect.error), 3) for k in (-2, 0, 2))
    return (
        f"{name}: all else being equal, errors with {level_text(effect.level)} are {middle} times those with "
        f"{level_text(effect.base)} (95 %: {low} to {high}){note}."
    )


def _against(entry: Comparison) -> str:
    level = level_text(entry.level)
    size = (
        f"With {level} the root mean square error is {significant(entry.ratio, 3)} times as large (geometric mean of "
        f"{plural(entry.pairs, 'comparison')})"
    )
    if not entry.worse and not entry.better:
        return f"{size}, no more than chance explains."
    other = f", smaller in {entry.better}" if entry.better else ""
    return f"{size}, significantly larger in {entry.worse} of them{other}."


def _comparison_table(comparisons: Sequence[Comparison]) -> Table:
    rows = tuple(
        (
            entry.factor,
            level_text(entry.level),
            level_text(entry.best),
            significant(entry.ratio, 3),
            str(entry.pairs),
            str(entry.worse),
            str(entry.better),
        )
        for entry in comparisons
    )
    note = (
        "Root mean square errors of the same quantity in two cases that differ in this factor alone; larger or smaller "
        "where that is by more than three standard errors."
    )
    header = ("Factor", "Level", "Best level", "RMSE ratio", "Comparisons", "Larger", "Smaller")
    return Table(header, rows, "Levels against the best of each factor", note)


def _spread_section(rows: Sequence[Row], plan: Layout) -> Section:
    if plan.across is None:
        return Section("Spread", ())
    every = panels(rows, plan.panels)
    note = (
        "Standard deviation over the size of the truth, geometric mean over the quantities of a kind. No unbiased "
        "estimator lies below the dashes; the distance from it is what better processing could gain."
    )
    pictures = tuple(
        picture(
            spread_figure(panel, plan.across, plan.apart),
            f"Spread against {plan.across}. {panel.title}".rstrip(),
        )
        for panel in every[:SPREAD_FIGURES]
    )
    return Section("Spread", (*_left_out(len(every), SPREAD_FIGURES), Gallery(pictures, note)))


def _left_out(there: int, most: int) -> tuple[Text, ...]:
    return (Text(f"{most} of {there} are shown, the first; summary.csv has all."),) if there > most else ()


def _quantile_section(rows: Sequence[Row], plan: Layout) -> Section:
    """Bars for the levels of one factor; where a number runs along the axis of the spread, at its largest value."""
    numeric = plan.across is not None and all(is_number(x) for x in levels(rows, plan.across))
    if len(levels(rows, plan.across)) > MANY:
        return Section("Estimates around the truth", ())
    apart = plan.apart if numeric or plan.apart is not None else plan.across
    apart_by = tuple(x for x in (*plan.panels, plan.across) if x not in (None, apart))
    shown = [
        row for row in rows if not numeric or row.factors[str(plan.across)] == levels(rows, plan.across)[-1]
    ]
    every = [panel for panel in panels(shown, apart_by) if any(row.count and row.truth for row in panel.rows)]
    note = (
        "Thick: the middle half of the estimates; thin: 95 % of them; tick: the median. Away from zero the method is "
        "biased; a thin line much longer than the thick one means rare but large errors."
    )
    pictures = tuple(
        picture(quantile_figure(panel, apart), f"Errors of the estimates. {panel.title}".rstrip())
        for panel in every[:QUANTILE_FIGURES]
    )
    if not pictures:
        return Section("Estimates around the truth", ())
    left_out = _left_out(len(every), QUANTILE_FIGURES)
    return Section("Estimates around the truth", (*left_out, Gallery(pictures, note)))


def _cases_section(study: Study, rows: Sequence[Row]) -> Section:
    every, names = by_case(rows), kinds(rows)
    header = ("Case", *study.varied, *(name.replace("_", " ") for name in names), "Failed")
    body = tuple(
        (
            str(case[0].case),
            *(level_text(case[0].factors[name]) for name in study.varied),
            *(_pooled_cell([row for row in case if row.kind == name]) for name in names),
            Cell(percent(failed_share(case)), tone="warning" if failed_share(case) >= FAILING else ""),
        )
        for case in every[:CASES]
    )
    note = "Standard deviation over truth, geometric mean over a kind's quantities; small: over the Cramér-Rao bound."
    return Section("Cases", (*_left_out(len(every), CASES), Table(header, body, "", note)))


def _pooled_cell(rows: Sequence[Row]) -> Cell:
    spread, bound = pooled(rows, "std"), pooled(rows, "cramer_rao")
    ratio = f"{significant(spread / bound, 3)}{TIMES}bound" if spread > 0 and bound > 0 else ""
    return Cell(percent(spread), ratio)


def _quantities_section(study: Study, rows: Sequence[Row]) -> Section:
    header = ("Quantity", "Truth", "Bias", "Std", "Robust std", "Cramér-Rao", "95 % from", "to")
    blocks: list[Block] = []
    for case in by_case(rows):
        if (
            sum(len(block.rows) for block in blocks if isinstance(block, Table)) + len(case) > QUANTITIES
            and blocks
        ):
            break
        title = f"Case {case[0].case}{_where(study, case[0])}"
        blocks.append(Table(header, tuple(_quantity(row) for row in case), title))
    note = (
        "± one standard error, from the number of realizations. A bias within twice its standard error may be chance. "
        "The robust standard deviation comes from the middle half: where it is much smaller, a few estimates are far "
        "off."
    )
    return Section("Quantities", (*_left_out(len(by_case(rows)), len(blocks)), Text(note), *blocks))


def _quantity(row: Row) -> tuple[str | Cell, ...]:
    doubtful = abs(row.bias) > 3 * row.bias_error
    return (
        Cell(row.quantity.replace("_", " "), row.unit),
        significant(row.truth),
        Cell(with_std(row.bias, row.bias_error), tone="warning" if doubtful else ""),
        with_std(row.std, row.std_error),
        significant(row.robust_std, 3),
        significant(row.cramer_rao, 3) if math.isfinite(row.cramer_rao) else MISSING,
        significant(row.q2_5, 5),
        significant(row.q97_5, 5),
    )


def _method_section() -> Section:
    words = (
        "Every realization adds noise with random numbers of its own to what the true system does, identifies it and "
        "keeps the estimates: results.parquet has all of them, summary.csv and summary.parquet what is summarized "
        "here. The Cramér-Rao bound is the least standard deviation that an unbiased estimator can have on these data, "
        "given the noise and the kind of system. Realizations that gave no value are counted as failures and left out "
        "of all other numbers."
    )
    return Section("How it was computed", (Text(words), Links(REFERENCES)))
