"""A summary of a diagnosis for the terminal."""

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel

from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.locate import Locations
from jaxsid.gap.words import APART
from jaxsid.report.numbers import change, misfit, percent, share_of, significant, with_std
from jaxsid.report.plots.places import label_of
from jaxsid.report.summary import table

PLACES = 6


def print_diagnosis(found: Diagnosis, console: Console | None = None) -> None:
    """Verdict, gap, places and remarks as rich tables, on standard output unless a console is given."""
    console = Console() if console is None else console
    sentence, meaning = found.summary
    console.print(f"\n[bold]{escape(found.nominal.name)}[/]: {sentence} {meaning}")
    console.print(_gap(found))
    if found.examination.locations is not None:
        console.print(_places(found.examination.locations))
    elif found.examination.before.total > APART:
        console.print(_numbers(found))
    if found.next_experiment:
        console.print(f"To measure next: {found.next_experiment}")
    if found.warnings:
        text = "\n".join(f"• {escape(warning)}" for warning in found.warnings)
        console.print(Panel(text, title="Remarks", border_style="yellow", title_align="left"))


def _gap(found: Diagnosis):
    seen = found.examination
    made = table(
        "Misfit (NRMSE)", "sensor", "nominal", "refitted", "noise alone", "gap (noise = 1)", "refitted"
    )
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


def _places(found: Locations):
    made = table("Where it arises", "place", "probability", "not told apart from")
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
