"""A study on the terminal: a bar while it runs, a table when it is done."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from jaxsid.digits import percent
from jaxsid.report.study_layout import failed_share, kinds, named, pooled
from jaxsid.study.configuration import Study
from jaxsid.study.engine import Progress
from jaxsid.study.summary import Row, by_case

SECONDS_BETWEEN = 10.0  # lines where there is no terminal
SHOWN = 40  # cases in the table


class View(NamedTuple):
    """Where a study tells how far it is, in numbers and in words."""

    progress: Callable[[Progress], None]
    say: Callable[[str], None]


@contextmanager
def study_view(quiet: bool) -> Iterator[View]:
    """A bar on standard error; where that is no terminal a line now and then."""
    console = Console(stderr=True)
    if quiet:
        yield View(lambda _: None, lambda _: None)
    elif console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]}"),
        )
        with Bar(*columns, console=console) as bar:
            task = bar.add_task("", total=None, left="")
            yield View(
                lambda p: bar.update(
                    task, description="realizations", completed=p.done, total=p.total, left=left(p)
                ),
                lambda text: bar.update(task, description=text),
            )
    else:
        yield View(_Lines(console).progress, lambda text: console.print(f"jaxsid: {text} ...", markup=False))


class _Lines:
    """A line when the last one is some time ago, and for the first and the last chunk."""

    def __init__(self, console: Console):
        self.console, self.last = console, -SECONDS_BETWEEN

    def progress(self, p: Progress) -> None:
        now = time.monotonic()
        if now - self.last >= SECONDS_BETWEEN or p.done == p.total:
            self.console.print(
                f"jaxsid: {p.done} of {p.total} realizations{left(p)}", markup=False, highlight=False
            )
            self.last = now


def left(p: Progress) -> str:
    """The remaining time in words; nothing where it is unknown or zero."""
    if p.seconds_left is None or p.done == p.total:
        return ""
    minutes, seconds = divmod(round(p.seconds_left), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f", {hours} h {minutes} min left"
    return f", {minutes} min {seconds} s left" if minutes else f", {seconds} s left"


def print_study(study: Study, rows: Sequence[Row], console: Console | None = None) -> None:
    """One line a case: spread of each kind of quantity over the truth, and failures; on standard output."""
    console = Console() if console is None else console
    every, names = by_case(rows), kinds(rows)
    table = Table(
        title=escape(study.name), title_justify="left", title_style="bold", header_style="dim", box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )  # fmt: skip
    table.add_column("case", overflow="fold")
    for column in (*(name.replace("_", " ") for name in names), "failed"):
        table.add_column(column, justify="right")
    for case in every[:SHOWN]:
        factors = ", ".join(named(name, case[0].factors[name]) for name in study.varied)
        spread = (percent(pooled([row for row in case if row.kind == name], "std")) for name in names)
        table.add_row(escape(f"{case[0].case} {factors}"), *spread, percent(failed_share(case)))
    console.print(table)
    console.print("[dim]Standard deviation over truth, geometric mean over the quantities of a kind.[/]")
    if len(every) > SHOWN:
        console.print(f"{SHOWN} of {len(every)} cases; all are in summary.csv.")
