"""The first half of a diagnosis: is the gap real, how large is it, and where does it arise."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.checks import require
from jaxsid.gap.locate import Locations, Scored, located, scored
from jaxsid.gap.measure import Gap, gap_of
from jaxsid.gap.noise import Noise, noise_of
from jaxsid.gap.null import SIGNIFICANT, Null, null_test, tolerance_tests
from jaxsid.gap.places import places_of
from jaxsid.gap.recalibrate import Recalibrated, as_given, recalibrated
from jaxsid.gap.spectra import in_time
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import ElementValues, LinearMatrices, element_matrices
from jaxsid.records import Record, as_array

FAR = 10.0  # times less that a refit leaves, from which on the tolerance may be wrong
NEARER = 2.0  # likewise, where the nominal model leaves more than there was
NEGLIGIBLE = 5e-4  # part of the response below which what was found is of no matter


class Beside(NamedTuple):
    """One record beside two models, each from the initial state that suits it best.

    Attributes:
        measured: (samples, outputs) of the model's sensors; NaN for those that the record lacks.
        nominal, refit: (samples, outputs) responses of the nominal and of the refitted model.
    """

    measured: Float[np.ndarray, "samples outputs"]
    nominal: Float[np.ndarray, "samples outputs"]
    refit: Float[np.ndarray, "samples outputs"]


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
        elements: values of the refitted model, their deviations, and the nominal ones.
        beside: each record with both models' responses.
        fit: the refitted model beside the records, weighed by these noises.
        scored: what stands behind the places.
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
    elements: ElementValues
    beside: tuple[Beside, ...]
    fit: Recalibrated
    scored: Scored | None

    @property
    def guessed(self) -> bool:
        """Whether noise is a guess from the quietest band: too high if the gap is there too, too low if coloured."""
        return self.finding == "structure" and any(n.degrees <= 0 for n in self.noises)

    @property
    def far_off(self) -> bool:
        """Whether the model's numbers lie so far from the truth that nothing told beside them is to be trusted."""
        useless = any(x > 1 for x in self.before.nrmse.values())
        return self.before.total > (NEARER if useless else FAR) * self.recalibrated.total

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


def examine(
    model: LumpedModel, records: Record | Sequence[Record], *, progress: Callable[[str], None] | None = None
) -> Examination:
    """Whether records part from a model, how far, and where that arises.

    Two questions are asked: could the model within its tolerance have given the records, and could any linear model of
    its structure. Yes and yes is agreement, no and yes an error of its parameters, no and no an effect that it lacks.

    Args:
        model: nominal; its effects are left out.
        records: one or several, each with some of the model's sensors.
        progress: called with a line of text as each stage begins.

    Returns:
        Examination.

    Raises:
        InputError: inputs or sensors are missing, or values that no record can have.
    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    require(len(records) > 0, "give at least one record.")
    say = progress or (lambda text: None)
    say("noise, and the best linear model")
    guessed = noise_of(model, records)
    freely = recalibrated(model, records, guessed, wide=True)
    within = recalibrated(model, records, freely.noises, wide=False, given=True, start=freely.change)
    say("is the gap real")
    places = places_of(model)
    null, near = null_test(freely, places), null_test(within, places)
    drawn = tolerance_tests(within, freely)
    structural = null.p_value < SIGNIFICANT and null.share > NEGLIGIBLE
    # what is of no matter is no reason to doubt the model, however surely it is there
    nominal = min(1.0, 3 * min(*drawn, near.p_value if near.share > NEGLIGIBLE else 1.0))
    off = structural or nominal < SIGNIFICANT
    # what an unmodelled law leaves is no noise
    noises = guessed if structural else freely.noises
    nothing = as_given(model, records, noises)
    after = as_given(freely.model, records, noises)
    say("how large it is")
    gaps = gap_of(nothing, records), gap_of(after, records)
    of = None
    if off:
        say("where it arises")
        of = scored(model, records, noises=noises)
    return Examination(
        finding="structure" if structural else "parameters" if off else "agreement",
        nominal_p_value=nominal,
        structural_p_value=null.p_value,
        null=null,
        before=gaps[0],
        recalibrated=gaps[1],
        refit=freely.model,
        locations=located(of) if structural and of is not None else None,
        noises=noises,
        elements=fitted_values(element_matrices(model), freely.change, freely.covariance),
        beside=tuple(_beside(nothing, after, number) for number in range(len(records))),
        fit=after,
        scored=of,
    )


def fitted_values(
    elements: LinearMatrices, change: Float[np.ndarray, " p"], covariance: Float[np.ndarray, "p p"]
) -> ElementValues:
    """Of refitted elements; those that cannot vary have no deviation.

    Args:
        elements: of the nominal model.
        change: their relative changes first, then what else was fitted.
        covariance: of these.
    """
    nominal, count = np.asarray(elements.nominal), len(elements.listed)
    covariance = np.asarray(covariance)[:count, :count]
    root = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return ElementValues(
        elements.listed,
        as_array(nominal * (1 + np.asarray(change)[:count])),
        as_array(np.abs(nominal) * root),
        as_array(covariance / root / root[:, None]),
        as_array(nominal),
    )


def _beside(nominal: Recalibrated, refit: Recalibrated, number: int) -> Beside:
    spectra = nominal.settings[number].spectra
    y = np.asarray(in_time(spectra, spectra.y))
    left = (np.asarray(in_time(x.settings[number].spectra, x.linear[number].left)) for x in (nominal, refit))
    y = np.where(np.asarray(spectra.present) > 0, y, np.nan)
    return Beside(y, *(y - x for x in left))
