"""The catalogue of effects as a page with a picture of every kind, and a picture alone."""

from pathlib import Path

from jaxsid.checks import InputError, require
from jaxsid.mechanics.effects.catalogue import CATALOGUE, forms_of, further_of, kind_named
from jaxsid.mechanics.effects.kind import Kind, Parameter
from jaxsid.report.effects import SYMBOLS, model_lines, scale_of, units_of
from jaxsid.report.plots.effects import effect_figure
from jaxsid.report.svg import file_svg

PAGE = "effects.md"
PICTURES = "effects"
HEAD = f"""# Effects beyond the linear model

Made by `make docs` from the catalogue; not to be edited.

Between two bodies, or a body and the ground, d is the displacement of the second end relative to the first and v its
rate; the force F acts as -F on the second and as +F on the first, on top of the connection's own spring and damper.
On a body a force acts as it is.

No law is smoothed. Where a force has a kink (backlash, end stops, bilinear springs, saturation) its derivative there is
that of one side, and finite. Dry friction jumps: its contacts slide, stop and stick as they are, and derivatives are
those of that motion, which has none where a contact is at the brink of sticking or breaking loose.

A parameter's size goes by its scale, which follows from how the place moves, and its prior is of the ratio to that
scale. In scales, {SYMBOLS}

Pictures: every parameter is one standard deviation into its prior, at a place that swings with 1 mm rms at 3 Hz and
carries 10 N rms. Above, the force over displacement and over velocity along swings of three amplitudes; below, the same
for all amplitudes, as a map over displacement and velocity. Of signals, a sine before and after.
"""


def page() -> str:
    """The page in Markdown."""
    index = [f"- [`{kind.name}`](#{kind.name}): {_escaped(kind.law)}" for kind in CATALOGUE.values()]
    return "\n".join([HEAD, *index, "", *(_section(kind) for kind in CATALOGUE.values())])


def write_page(folder: Path) -> None:
    """The page, and a folder of pictures beside it.

    Args:
        folder: made if it is not there.

    Raises:
        InputError: it cannot be written to.
    """
    try:
        (folder / PICTURES).mkdir(parents=True, exist_ok=True)
        (folder / PAGE).write_text(page(), encoding="utf-8")
        for kind in CATALOGUE.values():
            picture = folder / PICTURES / f"{kind.name}.svg"
            picture.write_text(file_svg(effect_figure(kind)), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written to: {error}") from error


def write_picture(name: str, file: Path) -> None:
    """The picture of one kind.

    Args:
        name: of the kind.
        file: ending in .svg or .png.

    Raises:
        InputError: no such kind, another ending, a file that cannot be written.
    """
    kind = kind_named(name, f"effect '{name}'")
    require(file.suffix in (".svg", ".png"), f"{file}: pictures end in .svg or .png.")
    figure = effect_figure(kind)
    try:
        if file.suffix == ".svg":
            file.write_text(file_svg(figure), encoding="utf-8")
        else:
            figure.savefig(file, dpi=200)
    except OSError as error:
        raise InputError(f"{file}: cannot be written: {error}") from error


def _section(kind: Kind) -> str:
    lines = [
        f"## {kind.name}" if not kind.form_of else f"### {kind.form_of} with `{further_of(kind)}`",
        "",
        f"{_escaped(kind.about)} Its place: `{kind.where}`.",
        "",
        f"    {kind.law}",
        "",
        "| parameter | unit (moving, turning) | least | default | scale | prior, next to the scale |",
        "|---|---|---|---|---|---|",
        *(_row(p) for p in kind.parameters),
        "",
        "```toml",
        model_lines(kind),
        "```",
        "",
        f"Source: {_escaped(kind.source)}",
        "",
    ]
    picture = [f"![What {kind.name} does]({PICTURES}/{kind.name}.svg)", ""] if not kind.form_of else []
    return "\n".join([*lines, *picture, *(_section(form) for form in forms_of(kind.name))])


def _row(p: Parameter) -> str:
    lowest = "" if p.lowest == -float("inf") else f"{p.lowest:g}"
    default = "required" if p.default is None else f"{p.default:g}"
    cells = (f"`{p.name}`", units_of(p), lowest, default, scale_of(p), str(p.prior))
    return f"| {' | '.join(cells)} |"


def _escaped(text: str) -> str:
    """Without what Markdown would take for emphasis."""
    return text.replace("*", "\\*").replace("_", "\\_").replace("|", "\\|")
