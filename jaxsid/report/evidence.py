"""Second part of the report: the figures that back the findings, the records, and how it was computed."""

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from jaxsid.digits import percent, significant
from jaxsid.identification import Identification
from jaxsid.records import CbsiDiagnostics, Record
from jaxsid.report.findings import TABLED
from jaxsid.report.frame import Cell, Gallery, Link, Links, Picture, Section, Table, Text, picture
from jaxsid.report.modes import modes_of
from jaxsid.report.plots import (
    frequency_figure,
    impulse_figure,
    matrix_figure,
    mode_shape_figure,
    pole_figure,
    singular_value_figure,
    stabilization_figure,
    time_figure,
)
from jaxsid.report.plots.impulse import ROWS, plain_time
from jaxsid.report.results import MATRICES

TIME_FIGURES, FREQUENCY_FIGURES, SHAPES, IMPULSES = 6, 4, 8, 3
REFINED = (
    ", which a least-squares fit to the records then refines: with the values of the nominal model's own masses, "
    "springs and dampers unless the records contradict that structure, else with free symmetric matrices. "
)
REFERENCES = (
    Link(
        "J.-N. Juang and R. S. Pappa, An eigensystem realization algorithm for modal parameter "
        "identification and model reduction, J. Guidance 8 (1985)",
        "https://doi.org/10.2514/3.20031",
    ),
    Link(
        "J.-N. Juang, J. E. Cooper and J. R. Wright, An eigensystem realization algorithm using data "
        "correlations (ERA/DC), Control Theory and Advanced Technology 4 (1988)"
    ),
    Link(
        "R. S. Pappa, K. B. Elliott and A. Schenk, Consistent-mode indicator for the eigensystem realization "
        "algorithm, J. Guidance 16 (1993)",
        "https://doi.org/10.2514/3.21092",
    ),
    Link(
        "K. F. Alvin and K. C. Park, Second-order structural identification procedure via state-space-based "
        "system identification, AIAA Journal 32 (1994)",
        "https://doi.org/10.2514/3.11997",
    ),
    Link("W. Heylen, S. Lammens and P. Sas, Modal Analysis Theory and Testing, KU Leuven (1997)"),
)


def time_section(found: Identification) -> Section:
    """Measured and modelled response of the worst fitting sensors of each record."""
    places = [
        (record, output)
        for record, given in enumerate(found.records)
        for output in found.outputs
        if output in given.outputs and np.isfinite(np.asarray(given.y)[:, given.outputs.index(output)]).any()
    ]
    misfit = dict(zip(found.outputs, np.nan_to_num(np.asarray(found.train_nrmse)).tolist(), strict=True))
    kept = sorted(sorted(places, key=lambda p: -misfit[p[1]])[:TIME_FIGURES])
    note = (
        "Top: the whole record. Middle: the marked stretch, where the two curves should coincide. "
        "Bottom: measured less modelled; where the model is right it is noise, mostly within ± two "
        "standard deviations (dashed)."
    )
    pictures = tuple(
        picture(time_figure(found, output, record), _fit_caption(found, output, record))
        for record, output in kept
    )
    left_out = _left_out(len(places), len(kept), "the worst fitting")
    return Section("Response in time", (*left_out, Gallery(pictures, note)))


def _fit_caption(found: Identification, output: str, record: int) -> str:
    row = found.outputs.index(output)
    misfit, floor = percent(float(found.train_nrmse[row])), percent(float(found.noise_floor[row]))
    return (
        f"{output} in {found.records[record].name}. Misfit {misfit}, all records; noise alone leaves {floor}."
    )


def _left_out(there: int, shown: int, which: str) -> tuple[Text, ...]:
    return (Text(f"{shown} of {there} are shown, {which}."),) if shown < there else ()


def frequency_section(found: Identification) -> Section:
    """Measured and modelled frequency responses."""
    if not found.frequency_fit:
        return Section("Frequency response", ())
    places = [
        (record, output, column)
        for record, fit in enumerate(found.frequency_fit)
        for row, output in enumerate(found.outputs)
        for column in range(fit.measured.shape[2])
        if np.isfinite(np.asarray(fit.measured)[:, row, column]).any()
    ]
    note = (
        "The model should follow the measured curve at and around the modes (dotted lines). A coherence "
        "near 1 means that the inputs explain the output; where it drops, noise or nonlinearity rules. "
        "Grey: outside the trusted band."
    )
    kept = places[:FREQUENCY_FIGURES]
    pictures = tuple(
        picture(frequency_figure(found, output, column, record), _source(found, output, column, record))
        for record, output, column in kept
    )
    return Section(
        "Frequency response", (*_left_out(len(places), len(kept), "the first"), Gallery(pictures, note))
    )


def _source(found: Identification, output: str, column: int, record: int) -> str:
    given = found.records[record]
    return f"{output} over {given.inputs[column]}, from {given.name}."


def shapes_section(found: Identification) -> Section:
    """Mode shapes and poles."""
    count = min(len(modes_of(found)), SHAPES)
    caption = (
        "Left: displacement of the sensors, largest component 1; a change of sign is a node between them. "
        "Right: the components in the complex plane; on one line, the sensors move in phase or against it."
    )
    pictures = [picture(mode_shape_figure(found, first, 4), caption) for first in range(0, count, 4)]
    meaning = (
        "Left of the vertical line a mode decays. Bars: two standard deviations; squares: the nominal model."
    )
    poles = picture(pole_figure(found), meaning)
    left_out = _left_out(len(modes_of(found)), count, "the slowest")
    return Section("Mode shapes and poles", (*left_out, Gallery((*pictures, poles))))


def order_section(found: Identification) -> Section:
    values = picture(
        singular_value_figure(found),
        "A drop after the filled points means that the data support this order and no more; a slope "
        "means noise.",
    )
    diagram = picture(
        stabilization_figure(found),
        "A column of green points over many orders is a mode of the structure; scattered points are noise. "
        "Dashed: the chosen order. Grey: sum of the measured responses, logarithmic.",
    )
    reason = f"Order {found.order}. {found.order_reason}"
    return Section("Order of the model", (Text(reason), Gallery((values, diagram))))


def impulse_section(found: Identification) -> Section:
    response = found.response
    words = f"Method: {response.method.rstrip('.')}."
    if response.band is not None:
        low, high = (significant(float(x), 3) for x in response.band)
        words += f" Trusted from {low} to {high} Hz; outside, the records do not excite the system enough."
    if not plain_time(found):
        words += (
            f" It was estimated in a Laguerre basis (pole {significant(float(response.pole), 4)}), which "
            "has no samples in time to compare, so that only the model's response is drawn."
        )
    caption = (
        "Answer to one sample of unit force: the model should follow the estimate until that drowns in noise."
    )
    count = min(found.time_response.shape[2], IMPULSES)
    pictures = tuple(picture(impulse_figure(found, column), caption) for column in range(count))
    left_out = _left_out(len(found.outputs), min(len(found.outputs), ROWS), "the first sensors")
    return Section("Impulse response", (Text(words), *left_out, Gallery(pictures)))


def matrix_pictures(found: Identification) -> tuple[Picture, ...]:
    """Heat maps of matrices too large for tables."""
    if found.matrices is None or len(found.matrices.mass) <= TABLED:
        return ()
    caption = "Blue is positive, orange negative, each panel on its own scale."
    return tuple(picture(matrix_figure(found, which), caption) for which in MATRICES)


def cbsi_section(found: Identification) -> Section:
    """What the first, direct estimate of the matrices tells about the data."""
    diagnostics = None if found.cbsi is None else found.cbsi.diagnostics
    if diagnostics is None:
        return Section("Consistency with a mechanical system", ())
    role = "the starting point of the fit" if found.refined else "what is reported, since nothing was refined"
    intro = (
        f"CBSI turns the state-space model into mass, damping and stiffness directly; its result is {role}. "
        "A state-space model of a real mechanical system passes these tests with 0; noise, missing modes and wrong "
        "sensor positions do not."
    )
    header = ("Test", "Value", "Meaning")
    return Section(
        "Consistency with a mechanical system", (Text(intro), Table(header, _cbsi_rows(diagnostics)))
    )


def _cbsi_rows(diagnostics: CbsiDiagnostics) -> tuple[tuple[str | Cell, ...], ...]:
    meanings = {
        "upper_block_error": (
            "Velocity is the rate of displacement",
            "distance from that identity, relative",
        ),
        "feedthrough_error": (
            "Force moves nothing at once",
            "jump of displacement or velocity per force, relative",
        ),
        "mass_asymmetry": ("Symmetric mass", "difference between the two triangles, relative"),
        "damping_asymmetry": ("Symmetric damping", "likewise; damping is the weakest of the three"),
        "stiffness_asymmetry": ("Symmetric stiffness", "likewise"),
        "negative_scales": (
            "Modes against their driving point",
            "number of modes whose force and sensor disagree in sign",
        ),
    }
    return tuple(
        (title, significant(float(getattr(diagnostics, name)), 2), Cell(meaning, tone="wide"))
        for name, (title, meaning) in meanings.items()
    )


def records_section(found: Identification) -> Section:
    header = ("Record", "Samples", "Rate (Hz)", "Duration (s)", "Inputs", "Sensors")
    return Section("Records", (Table(header, tuple(_record_row(record) for record in found.records)),))


def _record_row(record: Record) -> tuple[str | Cell, ...]:
    samples, dt = len(record.y), float(record.dt)
    inputs = [f"{name} ({hold} hold)" for name, hold in zip(record.inputs, record.hold, strict=True)]
    return (
        record.name,
        str(samples),
        significant(1 / dt, 5),
        significant(samples * dt, 4),
        Cell(_listed(inputs), tone="wide"),
        Cell(_listed(record.outputs), tone="wide"),
    )


def _listed(names: Sequence[str], most: int = 12) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def method_section(found: Identification) -> Section:
    """How it was computed, in words, and where to read more."""
    words = (
        "The impulse response is estimated from inputs and outputs. The eigensystem realization "
        "algorithm (ERA, or ERA/DC on its correlations) factors the block Hankel matrix of its samples "
        "and gives a state-space model; the eigenvalues are the poles, the eigenvectors seen by the "
        "sensors the mode shapes. Where sensors and inputs allow it, common-basis structural "
        "identification (CBSI) turns the model into mass, damping and stiffness"
        + (REFINED if found.refined else ". The fit that refines them was left out. ")
        + "Standard deviations follow from the noise of the records, to first order. The numbers of the "
        "nominal model are compared with, and are no prior."
    )
    return Section("How it was computed", (Text(words), Links(REFERENCES)))


def software() -> str:
    """Name and version of this library."""
    try:
        return f"jaxsid {version('jaxsid')}"
    except PackageNotFoundError:
        return "jaxsid"
