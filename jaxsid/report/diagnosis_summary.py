"""A summary of a diagnosis for the terminal."""

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel

from jaxsid.digits import change, misfit, percent, share_of, significant, with_std
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.locate import Locations
from jaxsid.gap.ranking import key_of
from jaxsid.gap.words import APART, kind_words, place_words
from jaxsid.report.causes_page import parameters_said
from jaxsid.report.plots.places import label_of
from jaxsid.report.summary import table

PLACES, EFFECTS = 4, 5
POSSIBLE = 0.01  # probability from which on parameters are shown


def print_diagnosis(found: Diagnosis, console: Console | None = None) -> None:
    """Verdict, closure, effects, what remains and what to measure, on standard output unless a console is given."""
    console = Console() if console is None else console
    sentence, meaning = found.summary
    console.print(f"\n[bold]{escape(found.nominal.name)}[/]: {escape(sentence)}")
    console.print(escape(meaning))
    console.print(_gap(found))
    if found.examination.locations is not None:
        console.print(_places(found.examination.locations, found.far_off))
    if found.causes is not None:
        console.print(_effects(found))
    if found.far_off or (found.causes is None and found.examination.before.total > APART):
        console.print(_numbers(found))
    console.print(escape(found.remaining))
    if found.next_experiment:
        console.print(f"To measure next: {escape(found.next_experiment)}")
    if found.warnings:
        text = "\n".join(f"• {escape(warning)}" for warning in found.warnings)
        console.print(Panel(text, title="Remarks", border_style="yellow", title_align="left"))


def _effects(found: Diagnosis):
    """The most probable of those that were tried; a dot marks what the improved model has."""
    made = table("Which effect", "effect", "probability", "parameters", "left (noise = 1)")
    chosen = {key_of(x["kind"], x["place"]) for x in found.selected()}
    for x in found.effects()[:EFFECTS]:
        mark = "● " if key_of(x["kind"], x["place"]) in chosen else ""
        said = f"{mark}{kind_words(x['kind'])} {place_words(x['place'])}"
        parameters = parameters_said(x["parameters"]) if x["probability"] >= POSSIBLE else ""
        made.add_row(escape(said), share_of(x["probability"]), escape(parameters), significant(x["left"], 3))
    return made


def _gap(found: Diagnosis):
    seen = found.examination
    alone = "noise, guessed" if seen.guessed else "noise alone"
    made = table("Misfit (NRMSE)", "sensor", "nominal", "refitted", alone, "gap (noise = 1)", "refitted")
    for name in seen.before.nrmse:
        made.add_row(
            escape(name),
            misfit(seen.before.nrmse[name]),
            misfit(seen.recalibrated.nrmse[name]),
            percent(seen.before.noise_floor[name]),
            significant(seen.before.noise_units[name], 3),
            significant(seen.recalibrated.noise_units[name], 3),
        )
    return made


def _places(found: Locations, far_off: bool):
    doubt = ", were the nominal numbers right" if far_off else ""
    made = table(f"Where it arises{doubt}", "place", "probability", "not told apart from")
    for x in found.ranked[:PLACES]:
        others = ", ".join(label_of(p) for p in x.together if p != x.place)
        made.add_row(escape(label_of(x.place)), share_of(x.probability), escape(others))
    return made


def _numbers(found: Diagnosis):
    values = found.examination.elements
    made = table("The model's numbers, refitted", "element", "nominal", "refitted", "change")
    numbers = (np.asarray(x).tolist() for x in (values.values, values.deviation, values.nominal))
    for x, value, std, nominal in zip(values.listed, *numbers, strict=True):
        made.add_row(escape(x.name), significant(nominal), with_std(value, std), change(value, nominal))
    return made
