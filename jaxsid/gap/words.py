"""A diagnosis in sentences: the finding, what remains, what to measure next."""

from typing import Any, Protocol, runtime_checkable

from jaxsid.digits import with_std
from jaxsid.gap.causes import Causes
from jaxsid.gap.closure import substantial
from jaxsid.gap.examine import Examination
from jaxsid.gap.experiment import Experiment
from jaxsid.gap.locate import located
from jaxsid.gap.measure import Gap
from jaxsid.gap.numbers import LEAST_CHANGE, at_the_least, off_numbers
from jaxsid.gap.places import Place
from jaxsid.gap.ranking import Explanation, ends_of
from jaxsid.gap.verdict import Verdict
from jaxsid.mechanics.lumped import LumpedModel

TELLS = 10.0  # log evidence below which an experiment is of no use
PARTS = 0.01  # of a body's motion that a sensor is worth asking for
NAMED = 6  # numbers that are off
BY_ITSELF = "What enters by a sensor of its own: it tells an error of the input from all else."
DOUBTED = 0.1  # probability of what is not in the catalogue from which on its reason is said
APART = 1.5  # gap in noise from which on refitted numbers are worth a word


@runtime_checkable
class Found(Protocol):
    """What the sentences need of a diagnosis."""

    @property
    def nominal(self) -> LumpedModel: ...
    @property
    def examination(self) -> Examination: ...
    @property
    def causes(self) -> Causes | None: ...
    @property
    def judgement(self) -> Verdict: ...
    @property
    def experiment(self) -> Experiment | None: ...
    @property
    def verdict(self) -> str: ...
    @property
    def far_off(self) -> bool: ...
    def probability(self, x: Explanation) -> float: ...
    def selected(self) -> list[dict[str, Any]]: ...


def kind_words(kind: str) -> str:
    """A kind in words: "coulomb friction".

    Args:
        kind: its name.
    """
    return kind.replace("_", " ")


def place_words(place: dict[str, Any]) -> str:
    """A place in words, to follow a kind.

    Args:
        place: as of an `Effect`.
    """
    ((where, ends),) = place.items()
    if where == "between":
        return f"between {ends[0]} and {ends[1]}"
    return f"{'on' if where == 'body' else 'of'} {ends}"


def named(x: Explanation) -> str:
    """Kind and place in words."""
    return f"{kind_words(x.kind)} {place_words(x.place)}"


def windows_words(causes: Causes | None) -> str:
    """How held-out samples were judged, where a model that drifts does not run on: ", in windows of 0.13 s", or "".

    Args:
        causes: of a diagnosis.
    """
    each = () if causes is None else dict.fromkeys(causes.before[0].windows)
    return f", in windows of {' or '.join(f'{x:.2g}' for x in each)} s" if each else ""


def percent(x: float) -> str:
    """With two digits."""
    return f"{float(f'{100 * x:.2g}'):g} %"


def summary(found: Found) -> tuple[str, str]:
    """The verdict and what it means, a sentence each.

    Args:
        found: the diagnosis.
    """
    causes = found.causes
    if causes is None or found.verdict == "none":
        told = "The records agree with the model, within its tolerance and the noise."
        if causes is not None:
            return (
                told,
                "Tests find a trace of something, too small beside the noise to be told or to matter.",
            )
        if found.examination.before.total > APART:
            return told, "Its numbers are off by no more than they may be; refitted it leaves noise alone."
        return told, "Nothing that the model lacks is to be seen in these records."
    closure = causes.closures[-1]
    anew = f"{windows}," if (windows := windows_words(causes)) else ""
    shrinks = (
        f"On samples that were not used{anew} the gap falls from {percent(closure.before)} to "
        f"{percent(closure.after)}; noise alone leaves {causes.most}{percent(closure.noise_floor)}."
    )
    if found.verdict == "unknown":
        likely = found.examination.locations
        if found.far_off:
            return (
                "The model's numbers are far from these records, and no kind of effect in the catalogue explains what "
                f"is left with better ones.{_near(found.judgement.imitating)}",
                shrinks,
            )
        place = "" if likely is None else _most_likely(likely.likely, causes)
        return (
            "The model lacks something that no kind of effect in the catalogue explains."
            f"{place}{_near(found.judgement.imitating)}",
            shrinks,
        )
    if not causes.selected:
        return "The model's structure is right, its numbers are not.", shrinks
    what = " and ".join(_sentence(found, i) for i in range(len(causes.selected)))
    if found.verdict == "ambiguous":
        others = ", ".join(named(x) for likely in found.judgement.likely for x in likely[1:])
        return f"{what[0].upper()}{what[1:]}. These records cannot tell it from {others}.", shrinks
    return f"{what[0].upper()}{what[1:]}.", shrinks


def _most_likely(places: tuple[Place, ...], causes: Causes) -> str:
    """A sentence of the places that are not told apart, first that of the law which comes nearest."""
    nearest = [ends_of(x.place) for r in causes.rounds[:1] for x in r.ranked[:1]]
    first, *others = sorted(places, key=lambda p: ends_of(p.as_dict()) not in nearest)
    said = f" Its place is most likely {_place(first)}"
    return f"{said}; not told from it: {', '.join(map(_place, others))}." if others else f"{said}."


def _near(imitating: tuple[Explanation, ...]) -> str:
    """What of the catalogue looks like a law that is not in it, if anything does."""
    said = " and ".join(map(named, imitating))
    if len(imitating) > 1:
        return f" Together, {said} imitate it."
    return f" What comes near it is {said}." if imitating else ""


def about_doubt(causes: Causes | None, verdict: Verdict) -> list[str]:
    """Why effects that were found are not sure, or not taken, where that is for what the catalogue does not hold.

    Args:
        causes: what was found.
        verdict: what is concluded of it.
    """
    unknown = verdict.probability["unknown"]
    if causes is not None and causes.unlisted and verdict.imitating:
        said = " and ".join(map(named, verdict.imitating))
        return [
            f"However near {said} may come: a force of another shape, of displacement and velocity there, explains "
            "more of what it leaves than chance ever does. The law is not in the catalogue, or another acts there, too."
        ]
    if verdict.outrun:
        said = " and ".join(map(named, verdict.imitating))
        return [
            f"However near {said} may come in the samples used: more is left of the others than noise and what is not "
            "known of the numbers make up."
        ]
    if causes is None or not causes.selected or verdict.name == "unknown" or unknown < DOUBTED:
        return []
    doubt = f"A probability of {unknown:.2f} is left for what the catalogue does not hold:"
    if verdict.paired:
        both = " and ".join(kind_words(x.kind) for x in verdict.paired)
        # a force on a body acts between it and the ground
        where = place_words(max((x.place for x in verdict.paired), key=lambda place: "between" in place))
        return [
            f"{doubt} two laws at one place, {both} {where}, may stand for a single one of another shape."
        ]
    closure = causes.telling
    those = "that were not used" if closure is causes.closures[-1] else "used"
    return [
        f"{doubt} what was found leaves {percent(closure.after)} on samples {those}, where the best linear "
        f"model leaves {percent(closure.recalibrated)} and noise alone {causes.most}"
        f"{percent(closure.noise_floor)}."
    ]


def about_held_out(causes: Causes | None) -> list[str]:
    """That samples which were not used do not show the gap, and how far it shrinks on those that do.

    Args:
        causes: what was found.
    """
    if causes is None or causes.telling is causes.closures[-1]:
        return []
    left, seen = causes.closures[-1], causes.seen
    return [
        f"The samples that were not used hardly show the gap: the nominal model leaves {percent(left.before)} of them, "
        f"noise {causes.most}{percent(left.noise_floor)}. So they do not prove what was found. Of those used, windows "
        f"that begin anew are left {percent(seen.before)} by the nominal model and {percent(seen.after)} with what was "
        "found. Measure again with the motion of these at the end, too."
    ]


def about_numbers(found: Examination) -> list[str]:
    """What the best linear model says of the nominal numbers, where no effect was found that says more.

    Args:
        found: the examination.
    """
    off, said = off_numbers(found.elements), []
    if off.common != 1:
        said.append(
            f"Refitted, masses and stiffnesses are {off.common:.3g} times the nominal ones. A gain of the inputs, or "
            "one of all sensors, does the same: these records cannot tell them apart."
        )
    if found.far_off:
        beside = " beside that" if off.common != 1 else ""
        listed = ", ".join(f"{name} {factor:.2g}" for name, factor in off.others[:NAMED])
        more = f", and {len(off.others) - NAMED} more" if len(off.others) > NAMED else ""
        told = f" Times the nominal value{beside}: {listed}{more}." if listed else ""
        said.append(
            "The numbers of the nominal model are far from these records. Unless an effect does that, neither place "
            f"nor kind of what else it lacks is to be trusted.{told} Run identify first, and diagnose with the model "
            "that it writes."
        )
    if least := at_the_least(found.elements):
        said.append(
            f"As small as is tried, {1 + LEAST_CHANGE:.2g} times the nominal value: {', '.join(least)}. The records "
            "may tell of less still, and the deviation of such a number says nothing."
        )
    return said


def about_inputs(model: LumpedModel, found: Examination) -> list[str]:
    """Inputs whose own noise is in what is left; nothing where more is left, which hides how much it is.

    Args:
        model: names them.
        found: the examination.
    """
    if found.finding == "structure":
        return []
    return [
        f"What is left holds what noise of the measured '{x.name}', {percent(part)} of its rms, makes the model do, as "
        "would a random force as small beside it. It counts as noise."
        for x, part in zip(model.inputs, found.null.input_noise, strict=True)
        if part > 0
    ]


def _place(place: Place) -> str:
    return " - ".join(place.ends) if place.where == "between" else f"{place.where} {place.ends[0]}"


def _sentence(found: Found, number: int) -> str:
    assert found.causes is not None
    x = found.causes.selected[number]
    given = found.selected()[number]["parameters"]
    values = ", ".join(_value(name, p) for name, p in given.items())
    return f"{named(x)} ({values}), probability {found.probability(x):.2f}"


def _value(name: str, p: dict[str, Any]) -> str:
    value = p["value"] if not isinstance(p["value"], list) else p["value"][0]
    unit = f" {p['unit']}" if p["unit"] else ""
    return f"{kind_words(name)} {with_std(value, p['std'])}{unit}"


def remaining(found: Found) -> str:
    """What is left once the selected effects are added.

    Args:
        found: the diagnosis.
    """
    causes, gap = found.causes, found.examination.recalibrated
    if causes is None or found.verdict == "none":
        return f"The linear model, its numbers refitted, leaves {gap.total:.3g} times the noise."
    if causes.places is None and found.verdict != "unknown":
        return "What remains: nothing significant."
    names = [s.name for s in found.nominal.sensors]
    closure = causes.closures[-1]
    worst = max(
        names, key=lambda n: closure.by_sensor[n] if closure.by_sensor[n] == closure.by_sensor[n] else 0.0
    )
    band = _loudest(gap)
    return (
        f"What remains: {percent(closure.by_sensor[worst])} of {worst}, where noise alone leaves "
        f"{causes.most}{percent(closure.noise_by_sensor[worst])}; the linear model misses most at {band}."
    )


def _loudest(gap: Gap) -> str:
    rows = [row for row in gap.by_frequency if row["significant"]] or list(gap.by_frequency)
    if not rows:
        return "no band in particular"
    low, high = max(rows, key=lambda row: row["noise_units"])["band_hz"]
    return f"{low:.3g} to {high:.3g} Hz"


def next_experiment(found: Found) -> str:
    """What to measure next.

    Args:
        found: the diagnosis.
    """
    causes = found.causes
    if causes is None or found.verdict == "none":
        told = all(n.degrees > 0 for n in found.examination.noises)
        return "" if told else "A record with repeated periods, or a quiet start, would tell the noise apart."
    if found.experiment is not None:
        return _experiment(found.experiment, next(x for x in found.judgement.likely if len(x) > 1))
    open_ones = [likely for likely in found.judgement.likely if len(likely) > 1]
    if open_ones:
        kinds = {x.kind for x in open_ones[0]}
        if len(kinds) == 1:
            open_places = " or ".join(place_words(x.place) for x in open_ones[0])
            return f"A longer record, or one more sensor: only the place is open, {open_places}."
        if kinds & {"input_delay", "actuator_lag", "input_gain", "actuator_saturation"}:
            return BY_ITSELF
        if kinds & {"coulomb_friction", "stribeck_friction", "quadratic_damping"}:
            return (
                "The same input at a third of its level, and a slow reversal: slow motion shows dry friction."
            )
        return "The same input at a third and at three times its level: how the force grows with it tells the law."
    if found.verdict != "unknown" and not substantial(
        causes.closures[-1].after, causes.closures[-1].noise_floor
    ):
        return ""
    places = _left_at(found)
    if any(place.where == "input" for place in places):
        return BY_ITSELF
    if len(places) > 1:
        ends = ", ".join(_place(place) for place in places)
        return f"One more sensor, on a body that {ends} move differently."
    return (
        "The same input at a third and at three times its level: how the force grows with it tells the law."
    )


def _left_at(found: Found) -> tuple[Place, ...]:
    """Where that may arise which the selected effects leave."""
    causes = found.causes
    if causes is not None and causes.selected:
        return () if causes.places is None else located(causes.places).likely
    return () if found.examination.locations is None else found.examination.locations.likely


def _experiment(x: Experiment, likely: tuple[Explanation, ...]) -> str:
    one, other = (named(y) for y in likely[:2])
    if x.told < TELLS:
        told = f"None of the inputs that were tried tells {one} from {other}."
    else:
        told = (
            f"{x.name[0].upper()}{x.name[1:]} (next_input.csv): it tells {one} from {other} by an expected difference "
            f"in log evidence of {x.told:.3g}."
        )
    if x.sensor is None or x.sensor[1] < PARTS:
        return told
    return f"{told} A displacement sensor on {x.sensor[0]} would show them {percent(x.sensor[1])} of its motion apart."
