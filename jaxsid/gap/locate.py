"""At which place an unmodelled effect acts, how surely, and the force that it exerts there."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsid.checks import require
from jaxsid.gap.apart import COMPARED, expected_differences, same_force, sets_of
from jaxsid.gap.force_map import ForceMap, force_map
from jaxsid.gap.noise import Noise, deviations, noise_of
from jaxsid.gap.places import Place, places_of
from jaxsid.gap.resume import step
from jaxsid.gap.scoring import Scores, scores
from jaxsid.gap.setting import Setting, element_directions, setting_of, slowest_rate
from jaxsid.gap.spectra import spectra_of
from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import element_matrices
from jaxsid.records import Record

# Raw evidence is overconfident, for what no basis of shapes holds decides, not noise: it is divided by this.
TEMPERATURE = 100.0
SAME = 2.0  # tempered difference of logarithms of evidence, found or expected, below which places are not told apart
MOST_MAPS = 3  # places of which the force is reported
UNEXPLAINED = (
    2.0  # mean square, in noise, across a place's transfer, from which on no force there explains the records
)


class Location(NamedTuple):
    """One place.

    Attributes:
        place: where.
        probability: of all places.
        evidence: its logarithm, less that of the first.
        across: mean square, in noise, of what no force at this place could explain; about 1 at the right one, NaN
            where one sensor leaves nothing to judge by.
        together: the places that these records cannot tell apart from it, with it, most probable first.
    """

    place: Place
    probability: float
    evidence: float
    across: float
    together: tuple[Place, ...]


class Locations(NamedTuple):
    """Where an unmodelled effect acts.

    Attributes:
        ranked: every place, most probable first.
        likely: the set of the first.
        maps: the force over time at the most probable of them, one a record.
        noises: of each record.
        remarks: what is to be known about it.
    """

    ranked: tuple[Location, ...]
    likely: tuple[Place, ...]
    maps: tuple[ForceMap, ...]
    noises: tuple[Noise, ...]
    remarks: tuple[str, ...]


class Scored(NamedTuple):
    """Evidence of places before it is weighed.

    Attributes:
        model: nominal.
        settings: of each record.
        noises: of each record.
        places: that were compared.
        tolerance: (e,) relative standard deviations of the model's elements.
        found: evidence, and what each place makes of the records.
    """

    model: LumpedModel
    settings: tuple[Setting, ...]
    noises: tuple[Noise, ...]
    places: tuple[Place, ...]
    tolerance: Float[np.ndarray, " e"]
    found: Scores


def locate(
    model: LumpedModel,
    records: Record | Sequence[Record],
    *,
    noises: Sequence[Noise] | None = None,
    places: Sequence[Place] | None = None,
) -> Locations:
    """The places where one force, or one error of a signal, explains what a model leaves of records.

    For place l the lines of what is left are r = sum_i c_i b_i + g_l f + noise: f a law of the motion there on a
    basis of shapes and a Matern-3/2 process for what that leaves, the c_i errors of the linear parameters within the
    model's tolerance and initial states. Evidence is closed, and the probability of l proportional to
    exp(evidence / T).

    Args:
        model: nominal; its effects are left out.
        records: one or several, each with some of the model's sensors.
        noises: one a record; None finds them.
        places: which to compare; None for all pairs of ends, sensors and inputs.

    Returns:
        Locations.

    Raises:
        InputError: inputs or sensors are missing, or names contradict.

    Source: M. Alvarez, D. Luengo, N. Lawrence, IEEE Trans. Pattern Analysis 35 (2013), for forces as processes.
    """
    return located(scored(model, records, noises=noises, places=places))


@step
def scored(
    model: LumpedModel,
    records: Record | Sequence[Record],
    *,
    noises: Sequence[Noise] | None = None,
    places: Sequence[Place] | None = None,
) -> Scored:
    """Evidence of every place, and what each makes of the records; arguments as of `locate`."""
    records = (records,) if isinstance(records, Record) else tuple(records)
    require(len(records) > 0, "give at least one record.")
    compared = places_of(model) if places is None else tuple(places)
    require(len(compared) > 0, "give at least one place.")
    noises = noise_of(model, records) if noises is None else tuple(noises)
    require(len(noises) == len(records), f"{len(records)} records need as many noises, not {len(noises)}.")
    # a sensor that no record has cannot be at fault
    seen = {name for r in records for name in r.outputs}
    compared = tuple(p for p in compared if p.where != "sensor" or p.ends[0] in seen)
    directions, rate = element_directions(model), slowest_rate(model)
    settings = []
    for record, noise in zip(records, noises, strict=True):
        spectra = spectra_of(model, record)
        settings.append(setting_of(spectra, deviations(noise, spectra), directions, rate))
    tolerance = np.array([getattr(model.tolerance, x.quantity) for x in element_matrices(model).listed])
    # Evidence is tempered, what is known of the model beforehand is not. Else records with little noise would pay for
    # the answer that explains all of them and means nothing: an input that is cancelled, masses and dampers of zero.
    found = scores(model, settings, compared, tolerance / np.sqrt(TEMPERATURE))
    return Scored(model, tuple(settings), noises, compared, tolerance, found)


def likeliest(of: Scored) -> Place:
    """The place whose evidence is largest.

    Args:
        of: from `scored`.
    """
    return of.places[int(_with_ties(of.found, of.places).argmax())]


def located(of: Scored) -> Locations:
    """What the evidence of places says.

    Args:
        of: from `scored`.
    """
    model, settings, noises, places, found = of.model, of.settings, of.noises, of.places, of.found
    value = _with_ties(found, places)
    order = [int(i) for i in np.argsort(-value, kind="stable")]
    same, alike = same_force(model, places), _alike(settings, found, value, order)
    sets = sets_of(order, alike | same)
    probability = _shared(value, sets, alike)
    across = _across(settings, found)
    ranked = tuple(
        Location(
            places[i],
            float(probability[i]),
            float(value[i] - value.max()),
            float(across[i]),
            tuple(places[j] for j in sets[i]),
        )
        for i in order
    )
    likely = sets[order[0]]
    maps = tuple(
        force_map(model, places[i], setting, made, i, found.process_force, noise, number)
        for i in likely[:MOST_MAPS]
        for number, (setting, made, noise) in enumerate(zip(settings, found.explained, noises, strict=True))
    )
    return Locations(ranked, tuple(places[i] for i in likely), maps, noises, _remarks(across, likely, places))


def _alike(
    settings: Sequence[Setting], found: Scores, value: np.ndarray, order: Sequence[int]
) -> Bool[np.ndarray, "places places"]:
    """[a, b]: whether b explains these records nearly as well as a, or would explain what a leaves in them."""
    limit = SAME * TEMPERATURE
    alike = np.abs(value[:, None] - value) < limit
    rows = np.array(order[:COMPARED])
    expected = expected_differences(settings, found.tried, found.explained, rows)
    alike[np.ix_(rows, rows)] |= expected < limit
    return alike


def _shared(
    value: np.ndarray, sets: Sequence[tuple[int, ...]], alike: Bool[np.ndarray, "places places"]
) -> np.ndarray:
    """Probabilities, of which those of a set that cannot be told apart take equal parts."""
    each = np.exp((value - value.max()) / TEMPERATURE)
    each = each / each.sum()
    for members in set(sets):
        equal = [i for i in members if i == members[0] or alike[members[0], i]]
        each[equal] = each[equal].mean()
    return each


def _with_ties(found: Scores, places: tuple[Place, ...]) -> np.ndarray:
    """Evidence, where one input and one sensor share it if delays and lags explain the records.

    Between one input and one sensor these commute with the model: at either end they do the same.
    """
    value = found.best.copy()
    signals = [i for i, p in enumerate(places) if p.where != "between"]
    if sorted(places[i].where for i in signals) == ["input", "sensor"]:
        value[signals] = np.maximum(value[signals], found.linear[signals].max())
    return value


def _across(settings: Sequence[Setting], found: Scores) -> np.ndarray:
    """Mean over the records that have two sensors or more."""
    told = [float(np.asarray(s.spectra.present).sum()) > 1 for s in settings]
    values = [np.asarray(x.across) for x, t in zip(found.explained, told, strict=True) if t]
    return np.mean(values, axis=0) if values else np.full(len(found.process), np.nan)


def _remarks(across: np.ndarray, likely: Sequence[int], places: tuple[Place, ...]) -> tuple[str, ...]:
    said = []
    if np.isnan(across).all():
        said.append(
            "One sensor at a time: a force at any place could explain what is left, so that only its shape tells where "
            "it acts. Two at once would tell more."
        )
    elif np.nanmin(across) > UNEXPLAINED:
        said.append(
            f"No force at a single place explains all of the gap: it leaves {np.sqrt(np.nanmin(across)):.3g} times the "
            "noise. There may be several effects, or errors of the linear parameters beyond their tolerance."
        )
    if len(likely) > 1:
        same = "input" in {places[i].where for i in likely}
        way = (
            "What an input does wrong is a force to every sensor, so that only its shape tells."
            if same
            else ""
        )
        labels = ", ".join(places[i].label for i in likely)
        said.append(f"These records do not tell apart: {labels}. {way or 'Another sensor would.'}")
    return tuple(said)
