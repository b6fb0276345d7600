"""What the model leaves of the records: white or not, independent of the inputs or not, and what that means."""

from typing import NamedTuple

import numpy as np

from jaxsid.digits import MISSING, minus, percent, significant
from jaxsid.identification import Identification
from jaxsid.pipeline.misses import NEGLIGIBLE, Peaks, cross_peaks, own_peaks
from jaxsid.report.frame import Cell, Gallery, Notice, Picture, Section, Table, Text, picture
from jaxsid.report.modes import worst_fits
from jaxsid.report.plots import residual_figure
from jaxsid.report.plots.residuals import COLOURS


class Left(NamedTuple):
    """What is left of one sensor, of the record where each correlation is strongest.

    Attributes:
        output: number of the sensor.
        record: where it follows an input most.
        own, crossed: value, lag (s), value that chance reaches, score over that of chance.
        given: name of the input that it follows most.
    """

    output: int
    record: int
    own: tuple[float, float, float, float]
    crossed: tuple[float, float, float, float]
    given: str


def residual_section(found: Identification) -> Section:
    """Table, words and figures of the correlations of what is left; empty where there are none."""
    if not found.residuals:
        return Section("Residuals", ())
    peaks = tuple(zip(own_peaks(found.residuals), cross_peaks(found.residuals), strict=True))
    left = [x for x in (_left(found, peaks, i) for i in worst_fits(found)) if x is not None]
    blocks = (_verdict(found, left), _table(found, left), Text(MEANING))
    return Section("Residuals", blocks + ((Gallery((_picture(found, left),)),) if left else ()))


def _picture(found: Identification, left: list[Left]) -> Picture:
    """The record and the sensors in it that follow the inputs most."""
    worst = sorted(left, key=lambda x: -np.nan_to_num(x.crossed[3]))
    record = worst[0].record
    shown = [
        found.outputs[x.output] for x in worst if found.outputs[x.output] in found.records[record].outputs
    ]
    shown = shown[: len(COLOURS)]
    which = f" Shown: {', '.join(shown)}." if len(shown) < len(left) else ""
    return picture(residual_figure(found, sorted(shown, key=found.outputs.index), record), CAPTION + which)


CAPTION = (
    "Top: what is left against itself, so much later. Bottom: the same, made white, against the input that it follows "
    "most. Dashed: what chance exceeds at one lag in a hundred, if the noise is white (top), if it has nothing to do "
    "with the input (bottom)."
)
MEANING = (
    "The residual is what was measured less what the model predicts. It should have nothing to do with the inputs: "
    "where it follows them the model misses something, such as a body, a connection, friction, play, or a delay. It "
    "need not be white: coloured noise of sensors and surroundings is allowed for, in the fit and in the standard "
    "deviations. But a residual that is neither white nor small may also be motion that no measured input drives, or a "
    "nonlinearity."
)


def _left(found: Identification, peaks: tuple[tuple[Peaks, Peaks], ...], output: int) -> Left | None:
    """The strongest correlations of one sensor over all records."""
    own = [_strongest(with_itself, (output,)) for with_itself, _ in peaks]
    crossed = [
        (*_strongest(with_input, (output, j)), i, name)
        for i, ((_, with_input), r) in enumerate(zip(peaks, found.records, strict=True))
        for j, name in enumerate(r.inputs)
    ]
    most = max(own, key=lambda x: np.nan_to_num(x[3], nan=-1.0))
    value, lag, reach, over, record, given = max(crossed, key=lambda x: np.nan_to_num(x[3], nan=-1.0))
    if not np.isfinite(most[3]) and not np.isfinite(over):
        return None
    return Left(output, record, most, (value, lag, reach, over), given)


def _strongest(peaks: Peaks, at: tuple[int, ...]) -> tuple[float, float, float, float]:
    value, lag, score = (float(x[at]) for x in (peaks.value, peaks.lag, peaks.score))
    reach = abs(value) * peaks.limit / score if score > 0 else float("nan")
    return value, lag, reach, score / peaks.limit


def _verdict(found: Identification, left: list[Left]) -> Notice:
    """Independent or not, white or not, in two sentences."""
    names = lambda chosen: ", ".join(found.outputs[x.output] for x in chosen)  # noqa: E731
    following = [x for x in left if x.crossed[3] > 1]
    telling = [x for x in following if float(found.train_nrmse[x.output]) > NEGLIGIBLE]
    coloured = [x for x in left if x.own[3] > 1]
    if not following:
        first = "What is left is independent of the inputs, as far as correlation tells: no sign of anything missing."
    elif not telling:
        first = f"What is left follows the inputs, but is less than {percent(NEGLIGIBLE)} of any sensor: rounding."
    else:
        first = f"What is left of {names(telling)} follows the inputs: the model misses something that they drive."
    second = "It is white, as the noise of sensors mostly is."
    if coloured:
        second = f"It is not white at {names(coloured)}: coloured noise"
        second += ", or motion that the model does not have." if telling else "."
    return Notice("Residual analysis", (first, second), "warning" if telling else "good")


def _table(found: Identification, left: list[Left]) -> Table:
    header = ("Sensor", "With itself, at most", "White", "With an input, at most", "Independent")
    rows = tuple(
        (
            found.outputs[x.output],
            _number(x.own, ""),
            Cell("no" if x.own[3] > 1 else "yes"),
            _number(x.crossed, f"{x.given}, "),
            Cell(*(("no", "", 0.0, "warning") if x.crossed[3] > 1 else ("yes", "", 0.0, "good"))),
        )
        for x in left
    )
    note = (
        "The strongest correlation, its lag, and what chance reaches over all lags, sensors and inputs once in ten "
        "thousand records of a right model. The input comes before the sensor; the other way round would be feedback."
    )
    return Table(header, rows, "", note)


def _number(strongest: tuple[float, float, float, float], which: str) -> Cell:
    value, lag, reach, _ = strongest
    if not np.isfinite(value):
        return Cell(MISSING)
    return Cell(minus(f"{value:.3f}"), f"{which}{lag:.3g} s; chance {significant(reach, 2)}")
