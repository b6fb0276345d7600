"""The second half of the page about a diagnosis: which effect, how far the gap shrinks, what remains."""

from typing import Any

import numpy as np

from jaxsid.digits import (
    MISSING,
    chance,
    change,
    misfit,
    percent,
    share_of,
    significant,
    with_std,
)
from jaxsid.gap.closure import Closure, Left
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.explain import elements_by_key
from jaxsid.gap.ranking import key_of
from jaxsid.gap.words import kind_words, named, place_words, windows_words
from jaxsid.mechanics.effects.catalogue import law_of
from jaxsid.report.frame import Block, Card, Cell, Gallery, Picture, Section, Table, Text, picture
from jaxsid.report.plots.causes import before_after_figure, chosen_name, held_out_pairs, spectra_figure

RANKED, TESTS, FIGURES = 6, 4, 3
MOST_SENSORS = 6  # columns of a table
SAME = 1.1  # ratio of two gaps that are about the same
OPEN = "● "
ORDINALS = ("First", "Second", "Third", "Fourth")


def closure_cards(found: Diagnosis) -> tuple[Card, ...]:
    """The numbers that matter where causes were looked for.

    Args:
        found: a diagnosis with causes.
    """
    closure = found.closure
    assert closure is not None
    verdict = found.judgement
    name = "unknown" if verdict.name == "unknown" else "effect"
    said = {
        "unknown": "that no kind in the catalogue explains it",
        "effect": "that the catalogue explains it",
    }
    remark = said[name]
    chance_of = verdict.probability[name]
    if found.causes is not None and found.causes.selected and name == "effect":
        chance_of *= float(np.prod([x.probability for x in found.causes.selected]))
        remark = "of this explanation, of all that were tried"
    # with less noise than its bound less would be explained
    supposed = ", if noise is as large as it may be" if _most(found) else ""
    samples = f"nominal model, held-out samples{windows_words(found.causes)} (NRMSE)"
    return (
        Card("Gap before", misfit(closure.before), samples),
        Card(
            "Gap after",
            misfit(closure.after),
            f"{chosen_name(found)}: {percent(closure.fraction)} of it explained{supposed}",
        ),
        Card("Noise alone", f"{_most(found)}{percent(closure.noise_floor)}", "as small as a gap can be"),
        Card("Probability", share_of(chance_of), remark),
    )


def _most(found: Diagnosis) -> str:
    return "" if found.causes is None else found.causes.most


def which_section(found: Diagnosis) -> Section:
    """What was selected, and how all that was tried compares.

    Args:
        found: a diagnosis.
    """
    if found.causes is None:
        return Section("Which effect", ())
    blocks: list[Block] = [_selected(found.selected())]
    if not found.causes.selected and found.verdict != "unknown":
        blocks.append(
            Text("All of the model's numbers together explain more than any one of the candidates below.")
        )
    effects = found.effects()
    rounds = sorted({x["round"] for x in effects})
    for number in rounds:
        own = [x for x in effects if x["round"] == number][:RANKED]
        blocks.append(_ranking(found, own, number, len(rounds)))
    return Section("Which effect", tuple(blocks))


def _selected(listed: list[dict[str, Any]]) -> Block:
    if not listed:
        return Text(
            "No kind of effect in the catalogue explains enough of the gap to be believed; the best of them follow."
        )
    note = (
        "Parameters ± one standard deviation, from how windows differ where more than noise is left; what the law "
        "itself misses is not in it. Gap after: NRMSE of the worst sensor, held-out samples."
    )
    header = ("Selected", "Parameters", "Law", "Gap after")
    return Table(header, tuple(_selected_row(x) for x in listed), "", note)


def _selected_row(x: dict[str, Any]) -> tuple[str | Cell, ...]:
    left = [v for v in x["gap_after"].values() if np.isfinite(v)]
    return (
        Cell(kind_words(x["kind"]), place_words(x["place"])),
        Cell(parameters_said(x["parameters"]), tone="wide"),
        Cell(law_of(x["kind"], x["parameters"]).law, tone="wide"),
        misfit(max(left)) if left else MISSING,
    )


def parameters_said(given: dict[str, Any]) -> str:
    """Parameters with deviation and unit.

    Args:
        given: by name, each with value, std and unit.
    """
    return (
        "; ".join(_parameter(kind_words(name.removesuffix("_hz")), p) for name, p in given.items()) or MISSING
    )


def _parameter(name: str, p: dict[str, Any]) -> str:
    several = isinstance(p["value"], list)
    value = p["value"][0] if several else p["value"]
    std = p["std"] if p["std"] > 0 else None
    unit = f" {p['unit']}" if p["unit"] else ""
    return f"{name} {with_std(value, std)}{unit}{' (first record)' if several else ''}"


def _ranking(found: Diagnosis, own: list[dict[str, Any]], number: int, rounds: int) -> Table:
    likely = found.judgement.likely
    open_keys = {x.key for x in likely[number - 1]} if number <= len(likely) else set()
    open_keys = open_keys if len(open_keys) > 1 else set()
    rows = tuple(
        (
            Cell(kind_words(x["kind"]), place_words(x["place"])),
            share_of(x["probability"]),
            Cell(parameters_said(x["parameters"]), tone="wide"),
            significant(x["left"], 3),
            Cell(_confusable(x, open_keys), tone="wide"),
        )
        for x in own
    )
    note = (
        "By the evidence of a fit, that is how well the best parameters explain the samples and how many others would "
        "have done as well. Left: rms of what a fit leaves of the samples it saw, noise = 1. Parameters of what was "
        "selected are those of the last fit, with all that was found."
    )
    if any(n.degrees == 0 for n in found.examination.noises):
        note += " That noise was guessed before any effect was known: a fit may leave less."
    if open_keys:
        note += f" {OPEN}one of those that these records cannot tell apart."
    title = "" if rounds == 1 else f"{ORDINALS[number - 1]} effect"
    return Table(
        ("Kind and place", "Probability", "Parameters", "Left (noise = 1)", "Not told apart from"),
        rows,
        f"All that were tried{f': {title.lower()}' if title else ''}",
        note if number == rounds else "",
    )


def _confusable(x: dict[str, Any], open_keys: set) -> str:
    others = [f"{kind_words(y['kind'])} {place_words(y['place'])}" for y in x["confusable_with"][:2]]
    mark = OPEN if key_of(x["kind"], x["place"]) in open_keys else ""
    return mark + (", ".join(others) or ("the others so marked" if mark else MISSING))


def before_after_section(found: Diagnosis) -> Section:
    """Held-out samples beside the nominal and the chosen model, in time and in frequency.

    Args:
        found: a diagnosis.
    """
    if found.causes is None:
        return Section("Before and after", ())
    pictures: list[Picture] = []
    for sensor, record in held_out_pairs(found, FIGURES):
        pictures.append(
            picture(
                before_after_figure(found, sensor, record),
                f"{sensor}. Middle: where the nominal model misses most; below: what each model leaves.",
            )
        )
        pictures.append(
            picture(
                spectra_figure(found, sensor, record),
                f"{sensor}. A gap that is closed leaves the level of the noise at every frequency.",
            )
        )
    told = Text(
        f"The last {_held_out(found)} of every record: nothing was chosen or fitted with them, but for the motion "
        "at their start."
    )
    return Section("Before and after", (told, Gallery(tuple(pictures))) if pictures else ())


def _held_out(found: Diagnosis) -> str:
    """Part of the records that is held out."""
    assert found.causes is not None
    parts = zip(found.causes.lefts[-1].left, found.records, strict=True)
    each = list(dict.fromkeys(percent(len(left) / len(r.y)) for left, r in parts))
    return " or ".join(each)


def closure_section(found: Diagnosis) -> Section:
    """How far the gap shrinks, by model and sensor.

    Args:
        found: a diagnosis.
    """
    causes, closure = found.causes, found.closure
    if causes is None or closure is None:
        return Section("How far it shrinks", ())
    names = [s.name for s in found.nominal.sensors][:MOST_SENSORS]
    every = [s.name for s in found.nominal.sensors]
    nominal, linear = (_by_sensor(x, every) for x in causes.before)
    rows = [_closure_row("nominal model", closure.before, nominal, names)]
    rows.append(_closure_row("its own numbers refitted", closure.recalibrated, linear, names))
    if not causes.selected:
        rows.append(_closure_row(chosen_name(found), closure.after, closure.by_sensor, names))
    for i, (x, step) in enumerate(zip(causes.selected, causes.closures, strict=False)):
        said = Cell(f"{'with' if i == 0 else 'and'} {kind_words(x.kind)}", place_words(x.place))
        rows.append(_closure_row(said, step.after, step.by_sensor, names))
    anew = windows_words(causes)
    anew = f"{anew}, each from the state that suits it best" if anew else ""
    floor = f"noise alone, {causes.most}".rstrip(", ")
    rows.append(_closure_row(floor, closure.noise_floor, closure.noise_by_sensor, names))
    low, high = closure.ci95
    note = (
        f"NRMSE on the last {_held_out(found)} of every record{anew}. Of the nominal model's gap above the noise "
        f"{percent(closure.fraction)} is gone (95 %: {percent(low)} to {percent(high)}); {_next_to_linear(closure)}. "
        "Explained = 1 − √((a² − n²) / (b² − n²)), with b "  # noqa: RUF001
        "before, a after and n the noise."
    )
    if causes.places is None and any(n.degrees <= 0 for n in causes.noises):
        note += " The noise is that which the chosen model leaves of the other samples, where tests find nothing in it."
    table = Table(("Model", "All sensors", *names), tuple(rows), "", note)
    return Section("How far it shrinks", (table,))


def _next_to_linear(closure: Closure) -> str:
    if closure.recalibrated <= SAME * closure.after:
        return "refitting its own numbers alone does as well"
    return f"of what refitting its own numbers leaves, {percent(closure.against_recalibrated)}"


def _closure_row(
    said: str | Cell, pooled: float, each: dict[str, float], names: list[str]
) -> tuple[str | Cell, ...]:
    return said, misfit(pooled), *(misfit(each[n]) if np.isfinite(each[n]) else MISSING for n in names)


def _by_sensor(x: Left, names: list[str]) -> dict[str, float]:
    """NRMSE of each sensor over all records."""
    left = np.sum([np.nansum(a**2, axis=0) for a in x.left], axis=0)
    return dict(zip(names, np.sqrt(left / _spread(x)).tolist(), strict=True))


def _spread(x: Left) -> np.ndarray:
    """Sum of squares of each sensor about its mean in every record; NaN for sensors that are nowhere."""
    whole = np.sum([np.nansum((y - _mean(y)) ** 2, axis=0) for y in x.measured], axis=0)
    return np.where(whole > 0, whole, np.nan)


def _mean(y: np.ndarray) -> np.ndarray:
    """Of each column; 0 for absent sensors."""
    return np.nansum(y, axis=0) / np.maximum(np.isfinite(y).sum(axis=0), 1)


def remaining_section(found: Diagnosis) -> Section:
    """What tests find in what is left, and effects that were tried and refused or that only come near.

    Args:
        found: a diagnosis.
    """
    causes = found.causes
    if causes is None:
        return Section("What remains", ())
    told = found.remaining.removeprefix("What remains: ")
    blocks: list[Block] = [Text(told[0].upper() + told[1:])]
    further = causes.rounds[len(causes.selected) :]
    unknown = found.verdict == "unknown"
    if (causes.selected or unknown) and further and further[0].ranked:
        next_one = named(further[0].ranked[0])
        said = (
            f"The law of the catalogue that comes nearest to it, {next_one}, does not explain it."
            if unknown
            else f"A further effect was tried: the most probable, {next_one}, would explain too little of what is left "
            "to be claimed."
        )
        blocks.append(Text(said))
    # beside what is unknown, tests were of what its stand-in leaves
    if causes.selected and not unknown:
        tests = sorted(causes.remaining.tests, key=lambda x: x.p_value)[:TESTS]
        rows = tuple((x.name, chance(x.p_value), percent(x.share)) for x in tests)
        note = (
            "The samples that were fitted, less what the effects do. By chance: how often noise alone would look so; "
            "share: what the test found next to the response."
        )
        blocks.append(Table(("Test of what is left", "By chance", "Share"), rows, "", note))
    return Section("What remains", tuple(blocks))


def next_section(found: Diagnosis) -> Section:
    """What to measure next.

    Args:
        found: a diagnosis.
    """
    told = found.next_experiment
    return Section("What to measure next", (Text(told),) if told else ())


def numbers_section(found: Diagnosis) -> Section:
    """The model's own numbers beside the effects that were chosen.

    Args:
        found: a diagnosis with causes.
    """
    of, linear = found.elements, found.examination.elements
    columns = (np.asarray(x).tolist() for x in (of.values, of.deviation, of.nominal, linear.values))
    named_wrong = {key_of(x["kind"], x["place"]) for x in found.selected()}
    wrong_rows = {i for key, own in elements_by_key(found.nominal).items() if key in named_wrong for i in own}
    rows = []
    for i, (element, value, std, nominal, alone) in enumerate(zip(of.listed, *columns, strict=True)):
        moved = change(value, nominal)
        rows.append(
            (
                element.name,
                significant(nominal),
                with_std(value, std) if nominal else MISSING,
                Cell(moved, tone="warning") if i in wrong_rows else moved,
                significant(alone),
            )
        )
    note = (
        "Fitted together with the effects, within the model's tolerance; those marked were singled out as wrong. ± one "
        "standard deviation. On the right the best numbers without any effect, which take up a part of what is missing."
    )
    header = ("Element", "Nominal", "In model.toml", "Change", "Without effects")
    return Section("The model's numbers", (Table(header, tuple(rows), "", note),))
