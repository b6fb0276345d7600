"""First part of the report: what was found, how well it fits, what to beware of."""

import numpy as np

from jaxsid.digits import MISSING, TIMES, change, misfit, percent, plural, significant, with_std
from jaxsid.identification import Identification
from jaxsid.mechanics.lumped import second_order
from jaxsid.mechanics.units import units_of
from jaxsid.report.frame import Block, Card, Cards, Cell, Notice, Section, Table, Tables, Text
from jaxsid.report.modes import Mode, compared, connecting, modes_of, worst_fits
from jaxsid.report.results import MATRICES

NO_MATRICES = (
    "These records do not determine the matrices. One driving point (a force and a sensor on the same "
    "body) and as many modes as bodies are needed; the warnings say what is missing. The modes above "
    "hold all the same."
)
FREE = "Symmetric matrices that fit the records best, in the order of the bodies."
UNREFINED = (
    "Matrices of CBSI alone, as they come, in the order of the bodies: nothing was refined, so that they need not be "
    "symmetric and have no standard deviations."
)
BY_ELEMENTS = (
    "Made of the model's own masses, springs and dampers, whose values were fitted to the records; entries which the "
    "model does not have are zero."
)
TABLED = 8  # larger matrices are shown as figures
GOOD_FIT, POOR_FIT = 1.2, 3.0  # misfit over noise floor
TRUSTED = 0.8  # indicators below this make a mode doubtful


def key_findings(found: Identification) -> Section:
    blocks = (Cards(_cards(found)), _warnings(found), modes_table(found))
    return Section("Key findings", blocks)


def _cards(found: Identification) -> tuple[Card, ...]:
    modes = modes_of(found)
    pairs = sum(not mode.real for mode in modes)
    worst = _worst(found)
    fit = "no fit was computed"
    if worst is not None:
        floor = float(np.asarray(found.noise_floor)[worst])
        fit = f"{found.outputs[worst]}; noise alone leaves {percent(floor)}"
    largest = MISSING if worst is None else percent(float(np.asarray(found.train_nrmse)[worst]))
    seen = [mode.frequency for mode in modes if not mode.real]
    span = "no vibration mode"
    if seen:
        ends = dict.fromkeys(significant(x, 3) for x in (min(seen), max(seen)))
        span = f"{' to '.join(ends)} Hz"
    matrices = ("not found", "see the warnings")
    if found.matrices is not None:
        size = str(len(found.matrices.mass))
        matrices = (size + TIMES + size, "mass, damping and stiffness")
    return (
        Card(
            "Modes",
            str(pairs),
            span + (f", {plural(len(modes) - pairs, 'real pole')}" if pairs < len(modes) else ""),
        ),
        Card("Largest misfit (NRMSE)", largest, fit),
        Card("Order", str(found.order), "states of the model"),
        Card("Matrices", *matrices),
    )


def _worst(found: Identification) -> int | None:
    """The output whose misfit is largest, None where there is none."""
    values = np.asarray(found.train_nrmse)
    return int(np.nanargmax(values)) if np.isfinite(values).any() else None


def _warnings(found: Identification) -> Notice:
    if not found.warnings:
        return Notice("No warnings.", (), "good")
    return Notice(plural(len(found.warnings), "warning"), found.warnings)


def modes_table(found: Identification) -> Table:
    """Frequencies, damping ratios and indicators of all modes, beside those of the nominal model."""
    rated = found.modal.indicators is not None
    header = ("Mode", "Frequency (Hz)", "Nominal", "Damping ratio (%)", "Nominal")
    rows = tuple(_mode_row(i, mode, rated) for i, mode in enumerate(modes_of(found), 1))
    note = (
        "± one standard deviation. Nominal: the nearest mode of the nominal model, and the change from it. "
    )
    if rated:
        note += (
            "MAC, EMAC and MPC near 1: a mode the data support (steady decay, the same over the whole "
            f"response, one phase for all sensors); below {TRUSTED} look at it twice. EMAC compares the "
            "late impulse response, where 5 % of the mode is left, with its start. MSV: the share in "
            "the response."
        )
    return Table(header + (("MAC", "EMAC", "MPC", "MSV") if rated else ()), rows, "Modes", note)


def _mode_row(number: int, mode: Mode, rated: bool) -> tuple[str | Cell, ...]:
    row = (
        Cell(str(number), f"real pole, {significant(mode.pole.real)} 1/s" if mode.real else ""),
        with_std(mode.frequency, mode.frequency_std),
        Cell(significant(mode.nominal_frequency), _known_change(mode.frequency, mode.nominal_frequency)),
    )
    return row + _damping(mode) + (_ratings(mode) if rated else ())


def _damping(mode: Mode) -> tuple[Cell, Cell]:
    """Damping ratio and that of the nominal model in percent; a real pole has none."""
    value, nominal = 100 * mode.damping_ratio, 100 * mode.nominal_damping_ratio
    unstable = mode.pole.real > 0
    remark, tone = ("unstable", "warning") if unstable else ("", "")
    if mode.real:
        return Cell(MISSING, remark, tone=tone), Cell("")
    found = Cell(with_std(value, 100 * mode.damping_ratio_std), remark, tone=tone)
    return found, Cell(significant(nominal), _known_change(value, nominal))


def _known_change(value: float, nominal: float) -> str:
    """The change against the nominal value, nothing where there is none."""
    return change(value, nominal) if nominal and np.isfinite(nominal) else ""


def _ratings(mode: Mode) -> tuple[Cell, ...]:
    values = [mode.indicators[name] for name in ("mac", "emac", "mpc")]
    rated = tuple(
        Cell(MISSING if np.isnan(x) else f"{x:.3f}", tone="warning" if x < TRUSTED else "") for x in values
    )
    return *rated, Cell(significant(mode.indicators["msv"], 3))


def matrices_section(found: Identification) -> Section:
    """Mass, damping and stiffness with deviations, or why there are none."""
    if found.matrices is None:
        return Section("Mass, damping, stiffness", (Text(NO_MATRICES),))
    origin = UNREFINED if not found.refined else FREE if found.elements is None else BY_ELEMENTS
    blocks: list[Block] = [Text(origin)]
    if len(found.matrices.mass) <= TABLED:
        blocks.append(Tables(tuple(_matrix(found, which) for which in MATRICES)))
    elements = _elements(found)
    return Section("Mass, damping, stiffness", (*blocks, *([elements] if elements else [])))


def _matrix(found: Identification, which: str) -> Table:
    values, nominal = (np.asarray(getattr(x, which)) for x in (found.matrices, second_order(found.nominal)))
    deviation = None if found.matrices_std is None else np.asarray(getattr(found.matrices_std, which))
    top, bodies = np.abs(values).max(initial=0.0), found.nominal.bodies
    rows = tuple(
        (
            body,
            *(
                Cell(
                    with_std(values[i, j], None if deviation is None else deviation[i, j]),
                    _beside(values[i, j], nominal[i, j]),
                    float(values[i, j] / top) if top > 0 else 0.0,
                )
                for j in range(len(bodies))
            ),
        )
        for i, body in enumerate(bodies)
    )
    units = units_of(found.nominal)
    title = f"{units.name(which).capitalize()} ({units.symbol(which)})"
    note = "Small: nominal value, change."
    if deviation is not None:
        note = f"± one standard deviation. {note}"
    return Table(("", *bodies), rows, title, note if which == MATRICES[-1] else "")


def _beside(value: float, nominal: float) -> str:
    return f"{significant(nominal)}, {change(value, nominal)}" if nominal else "nominal 0"


def _elements(found: Identification) -> Table | None:
    """Bodies and connections one by one, read off the matrices where these were not fitted by them."""
    model = found.nominal
    if found.matrices is None or found.elements is not None or model.matrices is not None:
        return None
    units = units_of(model)
    mass, std = np.diag(np.asarray(found.matrices.mass)), found.matrices_std
    bodies = zip(
        model.bodies,
        mass,
        np.full(len(mass), np.nan) if std is None else np.diag(std.mass),
        model.mass,
        strict=True,
    )
    rows = [(name, *_beside_nominal(*(float(x) for x in row)), "", "") for name, *row in bodies]
    rows += [_connection(found, i) for i in range(len(model.connections))]
    note = (
        "Read off the matrices: a connection between two bodies is their entry off the diagonal with "
        "the sign changed, one to ground the sum of a row. Below each nominal value: the change from "
        "it."
    )
    header = "Element", f"{units.name('mass').capitalize()} or stiffness", "Nominal", "Damping", "Nominal"
    title = f"Elements ({units.symbol('mass')}, {units.symbol('stiffness')}, {units.symbol('damping')})"
    return Table(header, tuple(rows), title, note)


def _connection(found: Identification, i: int) -> tuple[str | Cell, ...]:
    connection, model = found.nominal.connections[i], found.nominal
    name = Cell(connection.name, f" {MISSING} ".join(connection.between))
    if sum(set(other.between) == set(connection.between) for other in model.connections) > 1:
        return name, "in parallel with another", "", "", ""
    stiffness, damping = (
        _beside_nominal(*connecting(found, which, connection.between), float(getattr(model, which)[i]))
        for which in ("stiffness", "damping")
    )
    return name, *stiffness, *damping


def _beside_nominal(value: float, std: float, nominal: float) -> tuple[str, Cell]:
    return with_std(value, std), Cell(significant(nominal), _known_change(value, nominal))


def fit_section(found: Identification) -> Section:
    """How closely the models follow each sensor, before and after."""
    models = compared(found)
    rows = tuple(_fit_row(found, i, models) for i in worst_fits(found))
    header = ("Sensor", *(name for name, _ in models), "Noise floor", "Ratio", "Reading")
    note = (
        "NRMSE: rms of measured less modelled, over the standard deviation of the measured signal, all records, each "
        "model from its own best initial state. Noise floor: what a perfect model would leave. Ratio: of the model "
        "before the floor, to it. Near 1 nothing but noise is left; well above, the system does something that a "
        "linear model of this kind does not."
    )
    if found.nominal.effects:
        note += " The nominal model is taken without its effects."
    if len(rows) < len(found.outputs):
        note = f"The {len(rows)} worst of {len(found.outputs)} sensors. " + note
    return Section("Fit", (Table(header, rows, "Misfit (NRMSE), before and after", note),))


def _fit_row(found: Identification, i: int, models: list[tuple[str, np.ndarray]]) -> tuple[str | Cell, ...]:
    nrmse, floor = float(found.train_nrmse[i]), float(found.noise_floor[i])
    ratio = nrmse / floor if floor > 0 else float("nan")
    reading, tone = "noise floor unknown", ""
    if ratio <= GOOD_FIT:
        reading, tone = "noise only", "good"
    elif ratio > POOR_FIT:
        reading, tone = "far above noise", "warning"
    elif ratio > GOOD_FIT:
        reading = "above noise"
    shares = (misfit(float(values[i])) for _, values in models)
    return found.outputs[i], *shares, percent(floor), significant(ratio, 3), Cell(reading, tone=tone)
