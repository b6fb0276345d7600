"""The diagnosis of the gap between a model and records: what was found, in one immutable value."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxsid.checks import require
from jaxsid.compilation import release_programs
from jaxsid.gap.causes import Causes, causes_of
from jaxsid.gap.closely import LENGTH, followed_closely
from jaxsid.gap.closure import Closure
from jaxsid.gap.examine import Examination, examine, fitted_values
from jaxsid.gap.experiment import Experiment, experiment_between
from jaxsid.gap.explain import element_place, elements_by_key
from jaxsid.gap.held_out import seen_part, usual_end
from jaxsid.gap.later import later_than_agreed
from jaxsid.gap.measure import is_free_or_unstable
from jaxsid.gap.noise import SOURCES
from jaxsid.gap.ranking import ERRORS, Explanation, Key, Ranking, alike, key_of
from jaxsid.gap.refit import Refit
from jaxsid.gap.verdict import Verdict, as_pair, concluded, plain_place
from jaxsid.gap.words import (
    about_doubt,
    about_held_out,
    about_inputs,
    about_numbers,
    next_experiment,
    remaining,
    summary,
)
from jaxsid.mechanics.effects.catalogue import law_of
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.mechanics.units import units_of
from jaxsid.physical.elements import ElementValues, element_matrices
from jaxsid.records import Record

SURE = 3.0  # standard deviations from which on an element's change is one
MOVING = 0.05  # motion at a record's start, next to that of all of it, that is said
REVERSED = -0.5  # correlation of a response with what was measured below which a sign is wrong
UNSTABLE = 1e-6  # real part of a pole, next to the fastest, from which on it grows


class Diagnosis(NamedTuple):
    """What records say of a model.

    Attributes:
        nominal: the model, without effects that it may have.
        records: what was measured.
        examination: gap, tests, places and the force there, of the samples that are not held out.
        causes: what explains the gap; None where there is none.
        verdict: "none", where the records agree with the model within noise and its tolerance; "effect", where the
            selected effects explain them; "ambiguous", where others do as well; "unknown", where none does.
        judgement: the verdict with its probability and what is not told apart.
        experiment: that would tell the two most probable explanations apart; None where there is but one, or where a
            model that drifts away predicts nothing.
        warnings: what is to be known before these numbers are used.
    """

    nominal: LumpedModel
    records: tuple[Record, ...]
    examination: Examination
    causes: Causes | None
    judgement: Verdict
    experiment: Experiment | None
    warnings: tuple[str, ...]

    @property
    def verdict(self) -> str:
        return self.judgement.name

    @property
    def model(self) -> LumpedModel:
        """The improved model: with the selected effects and refitted numbers."""
        return self.examination.refit if self._fit is None else self._fit.model

    @property
    def elements(self) -> ElementValues:
        """The numbers of the improved model's elements."""
        if self._fit is None:
            return self.examination.elements
        elements, fit = element_matrices(self.nominal), self._fit.fit
        return fitted_values(elements, fit.theta, fit.covariance)

    @property
    def _fit(self) -> Refit | None:
        """That of the improved model; None where it is the best linear one."""
        return None if self.causes is None or self.verdict == "none" else self.causes.chosen

    @property
    def far_off(self) -> bool:
        """Whether the places are those of a model with wrong numbers, no effect that was found being the reason."""
        alone = self.causes is None or not self.causes.selected
        return self.verdict != "none" and alone and self.examination.far_off

    @property
    def closure(self) -> Closure | None:
        """How far the gap shrinks on held-out samples."""
        return None if self.causes is None else self.causes.closures[-1]

    @property
    def summary(self) -> tuple[str, str]:
        """The verdict and what it means, a sentence each."""
        return summary(self)

    @property
    def remaining(self) -> str:
        """What is left once the selected effects are added, in words."""
        return remaining(self)

    @property
    def next_experiment(self) -> str:
        """What to measure next, in words."""
        return next_experiment(self)

    def as_dict(self) -> dict[str, Any]:
        """What diagnosis.json holds."""
        return {
            "name": self.nominal.name,
            "verdict": self.verdict,
            "verdict_probability": self.judgement.probability,
            "finding": self.examination.finding,
            **self.examination.as_dict(),
            "effects": self.effects(),
            "selected": self.selected(),
            **self._others(),
            "closure": None if self.closure is None else self.closure.as_dict(),
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
        """Those of model.toml, and what they would be without effects, where they take up a part of what is missing."""
        of, linear = self.elements, self.examination.elements
        columns = (np.asarray(x).tolist() for x in (of.values, of.deviation, of.nominal, linear.values))
        return [
            {"name": x.name, "value": value, "std": std, "nominal": nominal, "value_without_effects": alone}
            for x, value, std, nominal, alone in zip(of.listed, *columns, strict=True)
        ]

    def probability(self, x: Explanation) -> float:
        """Of an explanation, next to all that were tried, to none, and to what is not in the catalogue.

        Args:
            x: of a round.
        """
        return x.probability * (1 - self.judgement.probability["unknown"])

    def effects(self) -> list[dict[str, Any]]:
        """Candidates of the rounds in which an effect was found, most probable first.

        Each with the number of its round, and the rms in noise that its fit leaves. Parameters of those selected are
        those of the last fit, as everywhere else; of the others, those that they were compared with.
        """
        if self.causes is None:
            return []
        count = max(len(self.causes.selected), 1)
        selected = {x.key for x in self.causes.selected}
        best: dict[Key, tuple[Explanation, Ranking, int]] = {}
        for number, ranking in enumerate(self.causes.rounds[:count], start=1):
            for x in ranking.ranked:
                if x.key not in best or best[x.key][0].probability < x.probability:
                    best[x.key] = x, ranking, number
        order = sorted(best.values(), key=lambda pair: -pair[0].probability)
        return [
            {
                **as_pair(x),
                "probability": self.probability(x),
                "parameters": self._parameters(x, self.causes.chosen if x.key in selected else x.refit),
                "confusable_with": [
                    as_pair(y) for y in ranking.ranked if y.key != x.key and alike(x, y, ranking)
                ],
                "round": number,
                "left": x.left,
            }
            for x, ranking, number in order
        ]

    def selected(self) -> list[dict[str, Any]]:
        """The best explanation, one effect after another; empty where nothing was found.

        Beside what is unknown, effects that act elsewhere and explain much by themselves.
        """
        if self.causes is None or self.verdict == "none":
            return []
        if not self.causes.selected:
            return self._wrong_numbers() if self.verdict != "unknown" else []
        chosen = self.causes.chosen
        return [
            {**as_pair(x), "parameters": self._parameters(x, chosen), "gap_after": closure.by_sensor}
            for x, closure in zip(self.causes.selected, self.causes.closures, strict=True)
        ]

    def _others(self) -> dict[str, Any]:
        if self.verdict != "ambiguous":
            return {}
        return {"ambiguous_with": [as_pair(x) for likely in self.judgement.likely for x in likely[1:]]}

    def _parameters(self, x: Explanation, refit: Refit) -> dict[str, Any]:
        """Values and deviations of one effect of a fit."""
        where = [key_of(e.kind, dict(e.place)) for e in refit.hypothesis.effects]
        if x.key not in where:
            return self._factor(x, refit)
        row = where.index(x.key)
        turning = units_of(self.nominal).turning
        found = {}
        effect = refit.hypothesis.effects[row]
        for p in law_of(effect.kind, effect.parameters).parameters:
            value = np.ravel(np.asarray(effect.parameters[p.name], float))
            unit = " or ".join(dict.fromkeys(p.unit)) if turning is None else p.unit[int(turning)]
            said = float(value[0]) if value.size == 1 else value.tolist()
            found[p.name] = {"value": said, "std": refit.deviations[row][p.name], "unit": unit}
        return found

    def _factor(self, x: Explanation, refit: Refit) -> dict[str, Any]:
        rows = elements_by_key(self.nominal).get(x.key, ())
        if not rows:
            return {}
        i, theta = rows[0], refit.fit.theta
        std = float(np.sqrt(max(refit.fit.covariance[i, i], 0.0)))
        return {"factor": {"value": 1 + float(theta[i]), "std": std, "unit": ""}}

    def _wrong_numbers(self) -> list[dict[str, Any]]:
        """Errors of the model's own numbers that stand out, where all of them together explain the gap.

        Those beyond their tolerance, farthest first; where none is, all that are sure.
        """
        assert self.causes is not None
        assert self.closure is not None
        fit, listed = self.causes.chosen.fit, element_matrices(self.nominal).listed
        nominal = np.asarray(element_matrices(self.nominal).nominal)
        found = []
        for i, element in enumerate(listed):
            change, std = float(fit.theta[i]), float(np.sqrt(max(fit.covariance[i, i], 0.0)))
            if nominal[i] == 0 or abs(change) < SURE * std:
                continue
            factor = {"value": 1 + change, "std": std, "unit": ""}
            place = plain_place(element_place(self.nominal, element))
            tolerance = getattr(self.nominal.tolerance, element.quantity)
            found.append((abs(change) / max(tolerance, std), ERRORS[element.quantity], place, factor))
        beyond = [x for x in found if x[0] > 1] or found
        return [
            {
                "kind": kind,
                "place": place,
                "parameters": {"factor": factor},
                "gap_after": self.closure.by_sensor,
            }
            for _, kind, place, factor in sorted(beyond, key=lambda x: -x[0])
        ]


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
    release_programs()  # those of systems of other sizes, should there be very many
    ends = tuple(map(usual_end, records))
    seen = tuple(map(seen_part, records, ends))
    found, causes, verdict = _judged(model, seen, records, progress)
    later = later_than_agreed(model, seen, records, found) if causes is None else causes.later
    if later != ends:
        if progress is not None:
            progress("the last samples hold far more than all before: again with most of those")
        seen = tuple(map(seen_part, records, later))
        found, causes, verdict = _judged(model, seen, records, progress)
    said = _warnings(model, seen, found, causes, verdict, initial == "rest")
    return Diagnosis(
        model, records, found, causes, verdict, _experiment(model, seen, causes, verdict, progress), said
    )


def _judged(
    model: LumpedModel,
    seen: tuple[Record, ...],
    whole: tuple[Record, ...],
    progress: Callable[[str], None] | None,
) -> tuple[Examination, Causes | None, Verdict]:
    """What records say, some samples at the end of each held out."""
    found = examine(model, seen, progress=progress)
    causes = None
    if found.finding != "agreement":
        causes = causes_of(model, seen, whole, found, progress=progress)
    return found, *concluded(found, causes)


def _experiment(
    model: LumpedModel,
    records: tuple[Record, ...],
    causes: Causes | None,
    verdict: Verdict,
    progress: Callable[[str], None] | None,
) -> Experiment | None:
    if causes is None or verdict.name != "ambiguous" or is_free_or_unstable(model):
        return None
    for ranking, likely in zip(causes.rounds, verdict.likely, strict=False):
        if len(likely) > 1 and not followed_closely(ranking.bench):
            if progress is not None:
                progress("what to measure next")
            return experiment_between(likely[0], likely[1], ranking.bench, records)
    return None


def _warnings(
    model: LumpedModel,
    records: tuple[Record, ...],
    found: Examination,
    causes: Causes | None,
    verdict: Verdict,
    rest: bool,
) -> tuple[str, ...]:
    said = about_doubt(causes, verdict) + about_held_out(causes)
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
    if verdict.name != "none" and (causes is None or not causes.selected):
        said += about_numbers(found)
    if causes is not None and any(followed_closely(x.bench) for x in causes.rounds):
        kind = causes.rounds[0].ranked[0].kind.replace("_", " ")
        said.append(
            f"Under the law of {kind} neighbouring motions part at once, so that no run follows a record for long. "
            "What is said of held-out samples is said of motions that may be corrected every "
            f"{LENGTH} samples, by about as much as noise hides."
        )
    said += _about_sensors(model, found) + about_inputs(model, found)
    if any(n.source == SOURCES[-1] for n in found.noises):
        said.append(
            "Nothing tells of the noise apart: its level is that of the quietest band, or of what the best linear "
            "model leaves. Noise units are as good as that."
        )
    said += _about_starts(records, found) if rest else []
    # what a law explains has its place by the law, not by the force alone
    if found.locations is not None and verdict.name in ("unknown", "ambiguous"):
        said += found.locations.remarks
    return tuple(said)


def _about_sensors(model: LumpedModel, found: Examination) -> list[str]:
    """Responses that have nothing to do with what was measured, or the opposite sign."""
    said: list[str] = []
    useless, against = [], []
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
        useless.append(f"'{sensor.name}'")
        if together < REVERSED:
            against.append(f"'{sensor.name}'")
    if useless:
        moves = f" {', '.join(against)} moves against the model" if against else ""
        hint = f"{moves}: is a sign reversed, there or of an input?" if against else ""
        said.append(
            f"Sensor {', '.join(useless)}: what the nominal model leaves is larger than the signal itself. Check unit, "
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
