"""The page about a diagnosis: is the gap real, how large is it, where does it arise, and how that was found."""

import numpy as np

from jaxsid.digits import (
    MISSING,
    TIMES,
    chance,
    change,
    minus,
    misfit,
    percent,
    plural,
    share_of,
    significant,
    with_std,
)
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.gap.examine import NEGLIGIBLE
from jaxsid.gap.locate import Location
from jaxsid.gap.null import SIGNIFICANT, Test
from jaxsid.report.causes_page import (
    before_after_section,
    closure_cards,
    closure_section,
    next_section,
    numbers_section,
    remaining_section,
    which_section,
)
from jaxsid.report.evidence import software
from jaxsid.report.frame import (
    Block,
    Card,
    Cards,
    Cell,
    Gallery,
    Link,
    Links,
    Notice,
    Section,
    Table,
    Text,
    page,
    picture,
)
from jaxsid.report.plots.gap import (
    amplitude_figure,
    band_figure,
    beside_figure,
    history_figure,
    horizon_figure,
    pairs,
)
from jaxsid.report.plots.places import force_figure, label_of, map_figure, place_figure

PLACES, TESTS, TIME_FIGURES, MAPS = 8, 6, 4, 3
REFERENCES = (
    Link(
        "R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed. (2012), ch. 6"
    ),
    Link(
        "M. Alvarez, D. Luengo and N. Lawrence, Linear latent force models using Gaussian processes, IEEE Trans. "
        "Pattern Analysis and Machine Intelligence 35 (2013)",
        "https://doi.org/10.1109/TPAMI.2013.86",
    ),
    Link(
        "R. Kass and A. Raftery, Bayes factors, J. American Statistical Association 90 (1995), for evidence by the "
        "method of Laplace",
        "https://doi.org/10.1080/01621459.1995.10476572",
    ),
    Link(
        "H. Künsch, The jackknife and the bootstrap for general stationary observations, Ann. Statist. 17 (1989)",
        "https://doi.org/10.1214/aos/1176347265",
    ),
    Link(
        "Y. Benjamini and Y. Hochberg, Controlling the false discovery rate, J. R. Statist. Soc. B 57 (1995)"
    ),
    Link("S. Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statistics 6 (1979)"),
)


def diagnosis_page(found: Diagnosis) -> str:
    """The report as HTML."""
    bodies = len(found.nominal.bodies)
    seconds = sum(len(record.y) * float(record.dt) for record in found.records)
    subtitle = (
        f"{plural(len(found.records), 'record')}, {significant(seconds, 3)} s in all, "
        f"{plural(len(found.nominal.sensors), 'sensor')}, {bodies} {'body' if bodies == 1 else 'bodies'}"
    )
    return page(
        f"Diagnosis: {found.nominal.name}",
        subtitle,
        diagnosis_sections(found),
        f"Made with {software()}. All values in SI units.",
    )


def diagnosis_sections(found: Diagnosis) -> tuple[Section, ...]:
    """All sections, for a report that holds more than this."""
    explained = found.causes is not None
    return (
        _findings(found),
        _gap(found),
        _where(found),
        which_section(found),
        _force(found),
        before_after_section(found) if explained else _in_time(found),
        closure_section(found),
        remaining_section(found),
        next_section(found),
        numbers_section(found) if explained and found.verdict != "none" else _numbers(found),
        _method(found),
    )


def _findings(found: Diagnosis) -> Section:
    tone = "good" if found.verdict == "none" else "warning"
    sentence, meaning = found.summary
    cards = _gap_cards(found) if found.causes is None else closure_cards(found)
    blocks: list[Block] = [Notice(sentence, (meaning, found.remaining), tone), Cards(cards)]
    if found.warnings:
        blocks.append(Notice(plural(len(found.warnings), "remark"), found.warnings))
    return Section("Findings", tuple(blocks))


def _gap_cards(found: Diagnosis) -> tuple[Card, ...]:
    """Of records that the model agrees with."""
    seen = found.examination
    worst = max(seen.before.nrmse, key=lambda name: np.nan_to_num(seen.before.nrmse[name]))
    floor = seen.before.noise_floor[worst]
    return (
        Card(
            "Gap",
            f"{significant(seen.before.total, 3)}{TIMES}noise",
            "nominal model, all sensors; 1 is noise alone",
        ),
        Card(
            "Largest misfit",
            misfit(seen.before.nrmse[worst]),
            f"{worst}; noise alone leaves {percent(floor)}",
        ),
        Card(
            "Its own numbers refitted",
            f"{significant(seen.recalibrated.total, 3)}{TIMES}noise",
            f"{worst}: {misfit(seen.recalibrated.nrmse[worst])}",
        ),
        Card(
            "Probability of no effect",
            share_of(found.judgement.probability["none"]),
            "that the model lacks nothing",
        ),
    )


def _gap(found: Diagnosis) -> Section:
    seen = found.examination
    alone = "Noise, guessed" if seen.guessed else "Noise alone"
    header = ("Sensor", "Nominal", "Refitted", alone, "Gap (noise = 1)", "Refitted (noise = 1)")
    rows = tuple(
        (
            name,
            misfit(seen.before.nrmse[name]),
            misfit(seen.recalibrated.nrmse[name]),
            percent(seen.before.noise_floor[name]),
            significant(seen.before.noise_units[name], 3),
            significant(seen.recalibrated.noise_units[name], 3),
        )
        for name in seen.before.nrmse
    )
    windows = "windows of one period of the slowest motion, since a free run drifts"
    how = windows if seen.before.windowed else "all records"
    note = (
        f"NRMSE: rms of measured less modelled over the standard deviation of the measured signal, {how}, each "
        "from the initial state that suits the model best. The gap in noise is what is left, made white, over the "
        f"noise: 1 is noise alone. Noise from: {', '.join(dict.fromkeys(n.source for n in seen.noises))}."
        + (" A guess: what the refitted model leaves of the quietest band." if seen.guessed else "")
    )
    pictures = [
        picture(
            band_figure(found), "In third octaves; dots: more than noise, at a false discovery rate of 1 %."
        ),
        picture(
            history_figure(found), "Nominal model. A gap that comes and goes with the motion depends on it."
        ),
        picture(
            amplitude_figure(found),
            "Nominal model, all sensors. A gap that grows with the displacement is elastic or a stop, one near zero "
            "velocity friction.",
        ),
        picture(
            horizon_figure(found),
            "How far ahead the models foretell, each window from the state that fits it best.",
        ),
    ]
    return Section(
        "How large it is", (Table(header, rows, "Misfit by sensor", note), Gallery(tuple(pictures)))
    )


def _where(found: Diagnosis) -> Section:
    places = found.examination.locations
    if places is None:
        return Section("Where it arises", ())
    rows = tuple(_place_row(x, i == 0) for i, x in enumerate(places.ranked[:PLACES]))
    doubt = "Not to be trusted: the nominal numbers are far from these records. " if found.far_off else ""
    note = doubt + (
        "How well one force between two ends, or one error of a sensor or of an input, explains what the model leaves: "
        "a law of the motion there and a smooth process for what that misses, with errors of the linear numbers within "
        "their tolerance beside it. Across: what no force at this place could explain, in noise; about 1 at the right "
        "one."
    )
    if any(len(x.together) > 1 for x in places.ranked[:PLACES]):
        note += (
            " Where places are not told apart, what bears one force or explains these records alike, the probability "
            "of one against another rests on the shape of its force alone."
        )
    table = Table(("Place", "Probability", "Log evidence", "Across", "Not told apart from"), rows, "", note)
    figure = picture(
        place_figure(places), "Filled: the most probable place, with those not told apart from it."
    )
    return Section("Where it arises", (table, Gallery((figure,))))


def _place_row(x: Location, first: bool) -> tuple[str | Cell, ...]:
    others = ", ".join(label_of(p) for p in x.together if p != x.place)
    return (
        label_of(x.place),
        share_of(x.probability),
        "0" if first else significant(x.evidence, 3),
        Cell(MISSING if np.isnan(x.across) else significant(np.sqrt(x.across), 3)),
        Cell(others or MISSING, tone="wide"),
    )


def _force(found: Diagnosis) -> Section:
    places = found.examination.locations
    if places is None or not places.maps:
        return Section("The force there", ())
    shown = places.maps[:MAPS]
    pictures = []
    for force in shown:
        if force.place.where == "between":
            pictures.append(picture(map_figure(found, force), MAP))
        pictures.append(
            picture(
                force_figure(found, force), "Smoothed from what the nominal model leaves; it knows no law."
            )
        )
    return Section("The force there", (Text(MEANING), Gallery(tuple(pictures))))


MEANING = (
    "The force that would have to act at the most probable place for the nominal model to give these records. Read the "
    "law off its shape: a curve over displacement is a spring, a step at zero velocity friction, flat in the middle a "
    "gap or a stop, a loop hysteresis."
)
MAP = minus(
    "Grey: samples; blue: their mean; orange: the law that was chosen, along the same motion, dashed where the other "
    "signal matters too. F acts as -F on the second end and as +F on the first: springs rise to the right."
)


def _numbers(found: Diagnosis) -> Section:
    values = found.examination.elements
    numbers = (np.asarray(x).tolist() for x in (values.values, values.deviation, values.nominal))
    columns = zip(values.listed, *numbers, strict=True)
    rows = tuple(
        (
            x.name,
            significant(nominal),
            with_std(value, std) if nominal else MISSING,
            change(value, nominal),
        )
        for x, value, std, nominal in columns
    )
    note = (
        "Least squares on the lines of the records, with a wide normal prior about the nominal values. ± one standard "
        "deviation of noise."
    )
    if found.examination.finding == "structure":
        note += " Since the structure is wrong these numbers have taken up a part of what is missing: do not use them."
    return Section(
        "The model's numbers, refitted",
        (Table(("Element", "Nominal", "Refitted", "Change"), rows, "", note),),
    )


def _in_time(found: Diagnosis) -> Section:
    pictures = tuple(
        picture(
            beside_figure(found, sensor, record),
            f"{sensor}. Middle: where the nominal model misses most; below: what each model leaves.",
        )
        for sensor, record in pairs(found, TIME_FIGURES)
    )
    return Section("Measured and modelled", (Gallery(pictures),) if pictures else ())


def _method(found: Diagnosis) -> Section:
    seen = found.examination
    tests = sorted(seen.null.tests, key=lambda x: x.p_value)[:TESTS]
    note = (
        f"Nothing is claimed unless chance would give it less than once in {1 / SIGNIFICANT:.0f} right models and it "
        f"is above {percent(NEGLIGIBLE)} of the response. Nominal model within its tolerance: probability "
        f"{chance(seen.nominal_p_value)}; any numbers of its elements: {chance(seen.structural_p_value)}."
    )
    table = Table(
        ("Test of what the refitted model leaves", "By chance", "Share"),
        tuple(_test(x) for x in tests),
        "",
        note,
    )
    return Section("How this was found", (table, Links(REFERENCES)))


def _test(x: Test) -> tuple[str, str, str]:
    return x.name, chance(x.p_value), percent(x.share)
