"""The diagnosis of the gap between a model and records: what was found, in one immutable value."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxsid.checks import require
from jaxsid.gap.examine import Examination, examine
from jaxsid.gap.noise import SOURCES
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import GROUND, LumpedModel, second_order
from jaxsid.physical.elements import Element
from jaxsid.records import Record

VERDICTS = {"agreement": "none", "parameters": "effect", "structure": "unknown"}
KINDS = {"mass": "mass_error", "damping": "damping_error", "stiffness": "stiffness_error"}
APART = 1.5  # gap in noise from which on refitted numbers are worth a word
SURE = 3.0  # standard deviations from which on an element's change is one
MOVING = 0.05  # motion at a record's start, next to that of all of it, that is said
REVERSED = -0.5  # correlation of a response with what was measured below which a sign is wrong
UNSTABLE = 1e-6  # real part of a pole, next to the fastest, from which on it grows


class Diagnosis(NamedTuple):
    """What records say of a model.

    Attributes:
        nominal: the model, without effects that it may have.
        records: what was measured.
        verdict: "none", where the records agree with the model within noise and its tolerance; "effect", where other
            values of its own elements explain them; "unknown", where a law that it lacks acts.
        examination: gap, tests, places and the force there.
        warnings: what is to be known before these numbers are used.
    """

    nominal: LumpedModel
    records: tuple[Record, ...]
    verdict: str
    examination: Examination
    warnings: tuple[str, ...]

    @property
    def summary(self) -> tuple[str, str]:
        """The verdict and what it means, a sentence each."""
        if self.examination.finding == "structure":
            return (
                "The model lacks something.",
                "No numbers of its masses, springs and dampers explain these records.",
            )
        refitted = "refitted within its own structure the model leaves noise alone."
        if self.examination.finding == "parameters":
            return (
                "The model's structure is right, its numbers are not.",
                f"{refitted[0].upper()}{refitted[1:]}",
            )
        told = "The records agree with the model, within its tolerance and the noise."
        if self.examination.before.total > APART:
            return told, f"Its numbers are off by no more than they may be; {refitted}"
        return told, "Nothing that the model lacks is to be seen in these records."

    @property
    def remaining(self) -> str:
        """What is left once the model's own numbers are right, in words."""
        gap = self.examination.recalibrated
        if self.verdict == "unknown":
            return (
                f"The best linear model of this structure leaves {gap.total:.3g} times the noise: a law that it does "
                "not have acts."
            )
        return f"The linear model, its numbers refitted, leaves {gap.total:.3g} times the noise."

    @property
    def next_experiment(self) -> str:
        """What to measure next, in words."""
        found = self.examination.locations
        if found is None:
            told = all(n.degrees > 0 for n in self.examination.noises)
            return (
                ""
                if told
                else "A record with repeated periods, or a quiet start, would tell the noise apart."
            )
        if any(place.where == "input" for place in found.likely):
            names = ", ".join(place.ends[0] for place in found.likely if place.where == "input")
            return f"What enters as {names} by a sensor of its own: it tells an error of the input from a force there."
        if len(found.likely) > 1:
            ends = ", ".join(place.label for place in found.likely)
            return f"One more sensor, on a body that {ends} move differently."
        return "The same input at a third and at three times its level: how the force grows with it tells the law."

    def as_dict(self) -> dict[str, Any]:
        """What diagnosis.json holds."""
        return {
            "name": self.nominal.name,
            "verdict": self.verdict,
            "finding": self.examination.finding,
            **self.examination.as_dict(),
            "selected": self._selected(),
            "elements": self._elements(),
            "forces": [
                {
                    "place": x.place.as_dict(),
                    "record": x.record,
                    "rms": float(np.sqrt((x.force**2).mean())),
                    "deviation": x.deviation,
                }
                for x in self._maps()
            ],
            "tests": [x._asdict() for x in self.examination.null.tests],
            "remaining": self.remaining,
            "next_experiment": self.next_experiment,
            "warnings": list(self.warnings),
        }

    def _maps(self):
        return () if self.examination.locations is None else self.examination.locations.maps

    def _elements(self) -> list[dict[str, Any]]:
        values = self.examination.elements
        columns = (np.asarray(x).tolist() for x in (values.values, values.deviation, values.nominal))
        return [
            {"name": x.name, "value": value, "std": std, "nominal": nominal}
            for x, value, std, nominal in zip(values.listed, *columns, strict=True)
        ]

    def _selected(self) -> list[dict[str, Any]]:
        """Errors of the model's own numbers, where these explain the gap: those that stand out."""
        if self.verdict != "effect":
            return []
        found = []
        for element, row in zip(self.examination.elements.listed, self._elements(), strict=True):
            nominal, std = row["nominal"], row["std"]
            if nominal == 0 or abs(row["value"] - nominal) < SURE * std:
                continue
            place = element_place(self.nominal, element)
            factor = {"value": row["value"] / nominal, "std": std / abs(nominal), "unit": ""}
            kind = KINDS[element.quantity]
            found.append((abs(factor["value"] - 1) / factor["std"], kind, place, factor))
        gap = self.examination.recalibrated.nrmse
        return [
            {"kind": kind, "place": place, "parameters": {"factor": factor}, "gap_after": gap}
            for _, kind, place, factor in sorted(found, key=lambda x: -x[0])
        ]


def element_place(model: LumpedModel, element: Element) -> dict[str, Any]:
    """Where a number of a model acts, as in diagnosis.json.

    Args:
        model: elements, or matrices, whose numbers bear the names of the bodies that they join.
        element: one of its numbers.
    """
    for connection in model.connections:
        if element.quantity != "mass" and element.element == connection.name:
            return {"between": list(connection.between)}
    ends = element.element.split(", ") if model.matrices is not None else [element.element]
    if len(ends) > 1:
        return {"between": ends}
    return {"body": ends[0]} if element.quantity == "mass" else {"between": [GROUND, *ends]}


def diagnose(
    model: LumpedModel,
    records: Record | Sequence[Record],
    *,
    initial: str = "estimate",
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Where a model and records part: whether that is noise, how large it is, and at which place it arises.

    The nominal model within its tolerance, and the best linear model of its structure, are tested against the records.
    Where neither is enough the evidence for a force at every connection, body, sensor and input is compared.

    Args:
        model: nominal, with tolerances; effects that it has are left out.
        records: one or several, each with some of the model's sensors; SI units.
        initial: "estimate" allows any motion at the start of a record; "rest" too, but warns of any.
        progress: called with a line of text as each stage begins.

    Returns:
        Diagnosis.

    Raises:
        InputError: inputs or sensors are missing, or values that no record can have.

    Source: R. Pintelon and J. Schoukens, System Identification, 2nd ed., ch. 6; M. Alvarez, D. Luengo, N. Lawrence,
    IEEE Trans. Pattern Analysis 35 (2013).
    """
    require(initial in ("estimate", "rest"), f"initial '{initial}' is unknown; choose 'estimate' or 'rest'.")
    records = (records,) if isinstance(records, Record) else tuple(records)
    found = examine(model, records, progress=progress)
    said = _warnings(model, records, found, initial == "rest")
    return Diagnosis(model, records, VERDICTS[found.finding], found, said)


def _warnings(
    model: LumpedModel, records: tuple[Record, ...], found: Examination, rest: bool
) -> tuple[str, ...]:
    said = []
    if model.effects:
        kinds = ", ".join(x.kind for x in model.effects)
        said.append(f"The model's effects ({kinds}) were left out: the gap is that of its linear part.")
    poles = np.linalg.eigvals(np.asarray(physical_displacement_velocity(second_order(model)).A))
    if (poles.real > UNSTABLE * np.abs(poles).max()).any():
        said.append(
            f"The model is unstable (a pole at {poles.real.max():.3g} 1/s): a free run of it says nothing, so that "
            "misfits are those of windows of one period of its slowest motion."
        )
    said += [
        f"{record.name}: its inputs are zero throughout, so that it shows free motion and noise alone."
        for record in records
        if not np.asarray(record.u).any()
    ]
    said += _about_sensors(model, found)
    if any(n.source == SOURCES[-1] for n in found.noises):
        said.append(
            "Nothing tells of the noise apart: its level is that of the quietest band, or of what the best linear "
            "model leaves. Noise units are as good as that."
        )
    said += _about_starts(records, found) if rest else []
    if found.locations is not None:
        said += found.locations.remarks
    return tuple(said)


def _about_sensors(model: LumpedModel, found: Examination) -> list[str]:
    """Responses that have nothing to do with what was measured, or the opposite sign."""
    said = []
    for j, sensor in enumerate(model.sensors):
        y, response = (
            np.concatenate([getattr(x, name)[:, j] for x in found.beside]) for name in ("measured", "refit")
        )
        if not np.isfinite(y).any():
            said.append(f"Sensor '{sensor.name}' is in none of the records.")
            continue
        if found.before.nrmse[sensor.name] <= 1:
            continue
        there = np.isfinite(y)
        together = float(np.corrcoef(y[there], response[there])[0, 1])
        hint = (
            " It moves against it: is its sign, or that of an input, reversed?" if together < REVERSED else ""
        )
        said.append(
            f"Sensor '{sensor.name}': what the nominal model leaves is larger than the signal itself. Check its unit, "
            f"place and kind, and the unit of the inputs.{hint}"
        )
    return said


def _about_starts(records: tuple[Record, ...], found: Examination) -> list[str]:
    said = []
    for record, beside in zip(records, found.beside, strict=True):
        size = np.sqrt((np.nan_to_num(beside.measured) ** 2).mean(axis=0))
        start = np.abs(np.nan_to_num(beside.refit[0]))
        moving = (size > 0) & (start > MOVING * size)
        if moving.any():
            said.append(
                f"{record.name}: it does not start at rest, as was asked for; its initial state was estimated."
            )
    return said
