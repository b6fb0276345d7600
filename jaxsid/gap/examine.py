"""The first half of a diagnosis: is the gap real, how large is it, and where does it arise."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxsid.checks import require
from jaxsid.gap.locate import Locations, locate
from jaxsid.gap.measure import Gap, gap_of
from jaxsid.gap.noise import Noise, noise_of
from jaxsid.gap.null import Null, null_test, tolerance_test
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import Recalibrated, as_given, recalibrated
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.records import Record

SIGNIFICANT = 0.005  # probability by chance from which on nothing is claimed: of two questions, 1 % together
FAR = 10.0  # times less that a refit leaves, from which on the tolerance may be wrong
NEGLIGIBLE = 0.002  # part of the response below which what was found is of no matter


class Examination(NamedTuple):
    """What records say of a model before any law is tried.

    Attributes:
        finding: "agreement"; "parameters", where a refitted linear model leaves noise alone; or "structure".
        nominal_p_value: of the records under the model within its tolerance.
        structural_p_value: of the records under the best linear model.
        null: the tests of the latter.
        before: gap of the nominal model.
        recalibrated: gap of the refitted one.
        refit: that model.
        locations: where the effect acts; None where the structure is not in doubt.
        noises: of each record.
    """

    finding: str
    nominal_p_value: float
    structural_p_value: float
    null: Null
    before: Gap
    recalibrated: Gap
    refit: LumpedModel
    locations: Locations | None
    noises: tuple[Noise, ...]

    def as_dict(self) -> dict[str, Any]:
        """The parts `gap` and `locations` of diagnosis.json."""
        found = self.locations.ranked if self.locations is not None else ()
        gap = {
            "before": self.before.nrmse,
            "recalibrated": self.recalibrated.nrmse,
            "noise_floor": self.before.noise_floor,
            "noise_units": self.before.noise_units,
            "noise_source": [n.source for n in self.noises],
            "by_windows": self.before.windowed,
            "p_value": self.nominal_p_value,
            "p_value_recalibrated": self.structural_p_value,
            "by_frequency": list(self.before.by_frequency),
            "by_amplitude": list(self.before.by_amplitude),
            "by_time": list(self.before.by_time),
            "by_sensor": list(self.before.by_sensor),
            "by_horizon": list(self.before.by_horizon),
        }
        locations = [
            {
                "place": x.place.as_dict(),
                "probability": x.probability,
                "told_apart": self.locations is not None and x.place not in self.locations.likely,
                "together": [p.as_dict() for p in x.together],
                "across": None if math.isnan(x.across) else x.across,
            }
            for x in found
        ]
        return {"gap": gap, "locations": locations}


def examine(model: LumpedModel, records: Record | Sequence[Record]) -> Examination:
    """Whether records part from a model, how far, and where that arises.

    Two questions are asked: could the model within its tolerance have given the records, and could any linear model of
    its structure. Yes and yes is agreement, no and yes an error of its parameters, no and no an effect that it lacks.

    Args:
        model: nominal; its effects are left out.
        records: one or several, each with some of the model's sensors.

    Returns:
        Examination.

    Raises:
        InputError: inputs or sensors are missing, or values that no record can have.
    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    require(len(records) > 0, "give at least one record.")
    guessed = noise_of(model, records)
    freely = recalibrated(model, records, guessed, wide=True)
    within = recalibrated(model, records, freely.noises, wide=False, given=True)
    places = places_of(model)
    null, near = null_test(freely, places), null_test(within, places)
    drawn = tolerance_test(within, freely)
    structural = null.p_value < SIGNIFICANT and null.share > NEGLIGIBLE
    # what is of no matter is no reason to doubt the model, however surely it is there
    nominal = min(1.0, 2 * min(drawn, near.p_value if near.share > NEGLIGIBLE else 1.0))
    off = structural or nominal < SIGNIFICANT
    # what an unmodelled law leaves is no noise
    noises = guessed if structural else freely.noises
    nothing = as_given(model, records, noises)
    after = as_given(freely.model, records, noises)
    return Examination(
        finding="structure" if structural else "parameters" if off else "agreement",
        nominal_p_value=nominal,
        structural_p_value=null.p_value,
        null=null,
        before=gap_of(nothing, records),
        recalibrated=gap_of(after, records),
        refit=freely.model,
        locations=_located(model, records, nothing, after) if structural else None,
        noises=noises,
    )


def _located(
    model: LumpedModel, records: tuple[Record, ...], nothing: Recalibrated, after: Recalibrated
) -> Locations:
    found = locate(model, records, noises=nothing.noises)
    ratio = math.sqrt(nothing.squares / max(after.squares, 1e-300))
    if ratio < FAR:
        return found
    remark = (
        f"A refitted linear model leaves {ratio:.2g} times less than the nominal one. Unless the effect does that, "
        "its parameters lie beyond their tolerance and the places are not to be trusted: "
        "run identify first, and diagnose with the model that it writes."
    )
    return found._replace(remarks=(*found.remarks, remark))
