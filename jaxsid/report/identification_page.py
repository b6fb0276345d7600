"""The page about an identification: findings first, then the evidence."""

from jaxsid.digits import plural, significant
from jaxsid.identification import Identification
from jaxsid.mechanics.units import units_of
from jaxsid.report.evidence import (
    cbsi_section,
    frequency_section,
    impulse_section,
    matrix_pictures,
    method_section,
    order_section,
    records_section,
    shapes_section,
    software,
    time_section,
)
from jaxsid.report.findings import fit_section, key_findings, matrices_section
from jaxsid.report.frame import Gallery, Link, Links, Section, Text, page
from jaxsid.report.parameters import parameters_section
from jaxsid.report.residuals import residual_section


def report_page(found: Identification, later: str | None = None) -> str:
    """The report as HTML.

    Args:
        found: what was identified.
        later: address of the report of a diagnosis with this model, to be pointed to.
    """
    first, *others = report_sections(found)
    sections = (first, *([] if later is None else [_later(later)]), *others)
    title = f"Identification: {found.nominal.name}"
    return page(title, _subtitle(found), sections, f"Made with {software()}. All values in SI units.")


def report_sections(found: Identification) -> tuple[Section, ...]:
    """All sections, for a report that holds more than this."""
    matrices, heat_maps = matrices_section(found), matrix_pictures(found)
    if heat_maps:
        matrices = Section(matrices.title, (*matrices.blocks, Gallery(heat_maps)))
    return (
        key_findings(found),
        matrices,
        parameters_section(found),
        fit_section(found),
        time_section(found),
        residual_section(found),
        frequency_section(found),
        shapes_section(found),
        order_section(found),
        impulse_section(found),
        cbsi_section(found),
        records_section(found),
        method_section(found),
    )


def _later(address: str) -> Section:
    told = "The model found here was then held against a later record of the same machine, to see what has changed."
    return Section("What came later", (Text(told), Links((Link("Diagnosis of the later record", address),))))


def _subtitle(found: Identification) -> str:
    seconds = sum(len(record.y) * float(record.dt) for record in found.records)
    kind = {True: "rotation", False: "translation", None: "translation or rotation"}[
        units_of(found.nominal).turning
    ]
    return (
        f"{plural(len(found.records), 'record')}, {significant(seconds, 3)} s in all, "
        f"{plural(len(found.outputs), 'sensor')}; units of {kind}"
    )
