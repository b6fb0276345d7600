"""The page that every report shares: sections of text, tables, cards, notices and figures in one HTML file.

    page("Title", "what it is of", [Section("Findings", (Text("..."), Table(...), Gallery((picture(...),))))])

Everything is escaped on the way into the page; nothing is fetched from elsewhere.
"""

from collections.abc import Sequence
from importlib.resources import files
from typing import NamedTuple

import jinja2
from matplotlib.figure import Figure

from jaxsid.report.svg import inline_svg


class Text(NamedTuple):
    """A paragraph."""

    text: str
    kind: str = "text"


class Notice(NamedTuple):
    """Messages that must not be missed; tone is "warning" or "good"."""

    title: str
    messages: tuple[str, ...]
    tone: str = "warning"
    kind: str = "notice"


class Card(NamedTuple):
    """One number that matters: what it is, the number, a remark."""

    title: str
    value: str
    remark: str = ""


class Cards(NamedTuple):
    cards: tuple[Card, ...]
    kind: str = "cards"


class Cell(NamedTuple):
    """A table cell: text, a small remark below it, shade from -1 to 1, tone "good", "warning" or none."""

    text: str
    small: str = ""
    shade: float = 0.0
    tone: str = ""


class Table(NamedTuple):
    """Rows of strings or cells; the first column names the row, a note below says what to look for."""

    header: tuple[str, ...]
    rows: tuple[tuple[str | Cell, ...], ...]
    title: str = ""
    note: str = ""
    kind: str = "table"


class Tables(NamedTuple):
    """Small tables beside one another."""

    tables: tuple[Table, ...]
    kind: str = "tables"


class Picture(NamedTuple):
    """A drawn figure with the sentence that says what to look for."""

    svg: str
    caption: str


class Gallery(NamedTuple):
    """Figures beside one another, over them what to look for in all."""

    pictures: tuple[Picture, ...]
    note: str = ""
    kind: str = "gallery"


class Link(NamedTuple):
    text: str
    address: str = ""


class Links(NamedTuple):
    """A list of references; an entry without address is plain text."""

    links: tuple[Link, ...]
    kind: str = "links"


Block = Text | Notice | Cards | Table | Tables | Gallery | Links


class Section(NamedTuple):
    title: str
    blocks: tuple[Block, ...]

    @property
    def anchor(self) -> str:
        return "".join(c if c.isalnum() else "-" for c in self.title.lower())


def picture(figure: Figure, caption: str) -> Picture:
    """The figure as inline SVG; its alternative text is the caption."""
    return Picture(inline_svg(figure, caption), caption)


def cell(entry: str | Cell) -> Cell:
    return Cell(entry) if isinstance(entry, str) else entry


def page(title: str, subtitle: str, sections: Sequence[Section], footer: str = "") -> str:
    """One self-contained HTML page."""
    text = files("jaxsid.report").joinpath("template.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["cell"] = cell
    return environment.from_string(text).render(
        title=title, subtitle=subtitle, sections=[s for s in sections if s.blocks], footer=footer
    )
