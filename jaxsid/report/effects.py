"""The catalogue of effects for a terminal: all kinds, or one with its parameters and how a model file gives it."""

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxsid.mechanics.effects.catalogue import CATALOGUE, forms_of, further_of, kind_named
from jaxsid.mechanics.effects.kind import Kind, Parameter

PLACES = {
    "between": 'between = ["ground", "body"]',
    "body": 'body = "body"',
    "sensor": 'sensor = "sensor"',
    "input": 'input = "input"',
}

SYMBOLS = (
    "rms values at the place, F force, d displacement, v velocity, s signal, w slowest natural frequency (rad/s); "
    "T length of the record."
)


def print_effects(console: Console | None = None) -> None:
    """All kinds: where they act, their law, their parameters.

    Args:
        console: where to; standard output where None.
    """
    table = Table(title="Effects beyond the linear model", title_justify="left", show_lines=False)
    for name in ("kind", "place", "law", "parameters"):
        table.add_column(name, overflow="fold")
    for kind in CATALOGUE.values():
        for law in (kind, *forms_of(kind.name)):
            names = ", ".join(_told(p) for p in law.parameters)
            table.add_row(kind.name, law.where, escape(law.law), escape(names))
    (console or Console()).print(table)


def print_effect(name: str, console: Console | None = None) -> None:
    """One kind in full.

    Args:
        name: of the kind.
        console: where to; standard output where None.

    Raises:
        InputError: no such kind.
    """
    kind, out = kind_named(name, f"effect '{name}'"), console or Console()
    _print(kind, f"[bold]{kind.name}[/bold]", out)
    for form in forms_of(name):
        _print(form, f"\n[bold]{kind.name}[/bold] with [bold]{further_of(form)}[/bold]", out)
    out.print(f"\nScales: {SYMBOLS}", highlight=False)
    out.print("In a model file:\n", highlight=False)
    further = [f"# {further_of(form)} = 1.0" for form in forms_of(name)]
    out.print(escape("\n".join([model_lines(kind), *further])), highlight=False, soft_wrap=True)


def _print(kind: Kind, name: str, out: Console) -> None:
    out.print(f"{name}: {escape(kind.law)}", highlight=False)
    out.print(escape(kind.about), highlight=False)
    table = Table()
    for column in (
        "parameter",
        "unit (moving, turning)",
        "least",
        "default",
        "scale",
        "prior, next to the scale",
    ):
        table.add_column(column)
    for p in kind.parameters:
        lowest = "" if p.lowest == -float("inf") else f"{p.lowest:g}"
        default = "required" if p.default is None else f"{p.default:g}"
        table.add_row(p.name, escape(units_of(p)), lowest, default, scale_of(p), str(p.prior))
    out.print(table)
    out.print(f"Source: {escape(kind.source)}", highlight=False)


def model_lines(kind: Kind) -> str:
    """How a model file gives an effect of this kind, with placeholders for names and numbers.

    Args:
        kind: one of the catalogue.
    """
    given = [p for p in kind.parameters if p.default is None] or list(kind.parameters[:1])
    lines = ["[[effects]]", f'kind = "{kind.form_of or kind.name}"', PLACES[kind.where]]
    return "\n".join([*lines, *(f"{p.name} = {float(p.typical)}" for p in given)])


def _told(parameter: Parameter) -> str:
    unit = parameter.unit[0]
    return f"{parameter.name} ({unit})" if unit else parameter.name


def scale_of(parameter: Parameter) -> str:
    """What a parameter's size goes by, in symbols.

    Args:
        parameter: of a kind.
    """
    text = str(parameter.scale) or "1"
    return f"({text})^n" if parameter.raised else text


def units_of(parameter: Parameter) -> str:
    """Units of a parameter where bodies move, and where they turn.

    Args:
        parameter: of a kind.
    """
    return ", ".join(dict.fromkeys(x for x in parameter.unit if x)) or "none"
