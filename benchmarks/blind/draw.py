"""A case from its seed: nominal model, true system, effects of a chosen severity, two records."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.signal
from excitation import drawn as signal_of
from families import FAMILIES, deviating, sensors
from laws import FORCES, INPUT, KINKED, OUTSIDE, SENSOR, UNLIKE
from plan import REFITTED, SETS, Planned
from plant import plant
from recalibrate import gap_left
from severity import Severity, severity
from sizes import ABSORBED, ANY, LIMITS, Scale, parameters, shape
from systems import GROUND, Effect, System, frequencies, joint, matrices, spring
from truth import Loop, respond, steps_of

SHORT = 2500  # samples on which sizes are chosen
TRIES = 7  # of a size
DRAWS = 12  # of a place and system, where an effect cannot be seen
GAPS = (0.3, 100.0)  # in noise
CHANGES = (0.01, 0.6)  # of the response
EXACT = 0.05  # largest change, in noise, when steps are halved
MOST_STEPS = 192
SAMPLES = (10_000, 5_000)
NEUTRAL = 1e-9  # what rounding adds to a pole at one
LEVELS = (0.4, 2.0)  # of the second record next to the first


class Case(NamedTuple):
    """Of a case: what the model says, what is recorded, and what is sealed.

    Attributes:
        nominal: system as the model has it.
        records: time-free columns (samples, 1 + sensors), the input first.
        label: what is not told.
    """

    nominal: System
    records: tuple[np.ndarray, ...]
    label: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class _Setup:
    """What is drawn before sizes: systems, excitation, how the records begin."""

    nominal: System
    true: System
    band: tuple[float, float]
    excitation: str
    loop: Loop | None
    level: float
    ratio: float
    before: float  # part of a record


class Drawn(NamedTuple):
    """An effect before it has a size."""

    kind: str
    where: str
    ends: tuple[str, ...]
    shape: dict[str, float]


def place_of(rng: np.random.Generator, kind: str, system: System) -> tuple[str, tuple[str, ...]] | None:
    """Where an effect of a kind may act; None if nowhere.

    Args:
        rng: draws one.
        kind: of effect.
        system: nominal.
    """
    bodies = list(system.bodies)
    joined = {frozenset(c.between) for c in system.connections}
    springs = [c.between for c in system.connections if c.stiffness > 0]
    free = [(GROUND, b) for b in bodies if frozenset((GROUND, b)) not in joined]
    pick = lambda x: x[int(rng.integers(len(x)))] if x else None  # noqa: E731
    if kind in SENSOR:
        return "sensor", (str(rng.choice([s.name for s in system.sensors])),)
    if kind in INPUT:
        return "input", (system.inputs[0].name,)
    if kind in ("mass_error", "missing_mode", *FORCES, "random_force"):
        return "body", (str(rng.choice(bodies)),)
    if kind == "missing_connection":
        others = [
            (a, b) for i, a in enumerate(bodies) for b in bodies[i + 1 :] if frozenset((a, b)) not in joined
        ]
        ends = pick(free + others)
    elif kind == "damping_error":
        ends = pick([c.between for c in system.connections])
    elif kind in ("stiffness_error", "backlash", "hysteresis", "iwan", "time_varying_stiffness", *KINKED):
        ends = pick(springs)
    elif kind in ("coulomb_friction", "stribeck_friction", "lugre", "quadratic_damping", "one_sided_damping"):
        ends = pick([c.between for c in system.connections] + free)
    else:
        ends = pick(springs * 2 + (free if any(GROUND in x for x in springs) else []))
    return None if ends is None else ("between", ends)


def _visible(rng: np.random.Generator, kinds: tuple[str, ...], system: System) -> System:
    """With displacement sensors where a constant load is to be seen."""
    if "constant_load" not in kinds or system.name == "two-inertia drive":
        return system
    at = rng.permutation(len(system.sensors))[:2]
    changed = [
        s._replace(name=f"dis_{s.body}", kind="displacement") if i in at and len(system.bodies) > 1 else s
        for i, s in enumerate(system.sensors)
    ]
    if not any(s.kind == "displacement" for s in changed):
        changed[0] = changed[0]._replace(name=f"dis_{changed[0].body}", kind="displacement")
    return system._replace(sensors=tuple(changed))


def _loop(rng: np.random.Generator, system: System) -> Loop | None:
    """Feedback of a sensor on the driven body; None without one that has no feedthrough."""
    body = system.inputs[0].body
    at = [i for i, s in enumerate(system.sensors) if s.body == body and s.kind != "acceleration"]
    if not at:
        return None
    mass, w = system.mass[system.bodies.index(body)], frequencies(system)[0]
    rate = 2 * rng.uniform(0.03, 0.15) * w * mass
    loop = Loop(at[0], rate, 0.0)
    if system.sensors[at[0]].kind == "displacement":
        loop = Loop(at[0], rng.uniform(0.05, 0.3) * w**2 * mass, rate)
    while _grows(system, loop):
        loop = loop._replace(gain=loop.gain / 2, rate_gain=loop.rate_gain / 2)
    return loop


def _grows(system: System, loop: Loop) -> bool:
    """Whether a sampled loop lets the motion grow: poles of state and last reading, input held over each sample."""
    linear = plant(system, (), 0.0)
    n, seen = len(linear.A), linear.C[loop.sensor]
    step = scipy.linalg.expm(
        system.dt * np.pad(np.column_stack([linear.A, linear.B[:, 0]]), ((0, 1), (0, 0)))
    )
    rate = loop.rate_gain / system.dt
    moved = step[:n, :n] - (loop.gain + rate) * np.outer(step[:n, n], seen)
    closed = np.block([[moved, rate * step[:n, n:]], [seen, 0.0]])
    return bool(np.abs(np.linalg.eigvals(closed)).max() > 1 + NEUTRAL)


def _setup(rng: np.random.Generator, case: Planned) -> _Setup:
    nominal, band = FAMILIES[case.family](rng)
    nominal = nominal._replace(sensors=sensors(rng, case.family, nominal, case.one_sensor))
    nominal = _visible(rng, case.kinds, nominal)
    loop = _loop(rng, nominal) if case.excitation == "closed_loop" else None
    excitation = case.excitation if loop is not None or case.excitation != "closed_loop" else "random"
    scale = sum(nominal.mass) * 10 ** rng.uniform(-2, 1)
    before = float(rng.uniform(0.02, 0.08)) * bool(rng.random() < 0.5)
    ratio = float(np.exp(rng.uniform(*np.log(LEVELS))))
    return _Setup(nominal, deviating(rng, nominal), band, excitation, loop, scale, ratio, before)


class _Run(NamedTuple):
    u: np.ndarray
    y: np.ndarray
    before: int


def _record(
    setup: _Setup,
    effects: tuple[Effect, ...],
    seed: list[int],
    samples: int,
    level: float,
    steps: int,
    fed_back: float,
) -> _Run:
    """A motion; the same seed gives the same signals."""
    rng = np.random.default_rng(seed)
    before = int(setup.before * samples)
    u = level * signal_of(setup.excitation, rng, before + samples, setup.true.dt, setup.band)
    noise = fed_back * rng.standard_normal(len(u)) if setup.loop else None
    other = signal_of("random", rng, len(u), setup.true.dt, setup.band)
    with np.errstate(all="ignore"):
        made = respond(
            setup.true,
            effects,
            u,
            before=before,
            steps=steps,
            loop=setup.loop,
            noise=noise,
            disturbance=other,
        )
    return _Run(made.u, made.y, before)


def _scale(setup: _Setup, where: str, ends: tuple[str, ...], run: _Run, length: float) -> Scale:
    """Of the motion at a place, from a motion without effects, all bodies measured."""
    system = setup.true
    w = frequencies(system)
    if where == "between":
        e = joint(system, ends)
    elif where == "body":
        e = joint(system, (GROUND, ends[0]))
    else:
        e = joint(system, (GROUND, system.inputs[0].body))
    n, y = len(system.bodies), run.y[run.before :]
    d, v, a = (y[:, i * n : (i + 1) * n] @ e for i in range(3))
    body = system.bodies.index(ends[-1]) if where in ("between", "body") else 0
    k = spring(system, ends) if where == "between" else 0.0
    M, _, K = matrices(system)
    moved = float(np.sqrt(np.mean((d - d.mean()) ** 2)))
    force = k * moved if k else max(float(M[body, body] * a.std()), 0.3 * float(K[body, body]) * moved)
    signal = 0.0
    if where == "sensor":
        sensor = next(s for s in system.sensors if s.name == ends[0])
        which = ("displacement", "velocity", "acceleration").index(sensor.kind)
        signal = float(y[:, which * n + system.bodies.index(sensor.body)].std())
    modes = tuple(float(x) for x in w / (2 * np.pi))
    peak = float(np.abs(run.u).max())
    reach = float(np.abs(d).max())
    return Scale(force, moved, float(v.std()), reach, system.mass[body], signal, peak, modes, length)


def _everywhere(setup: _Setup) -> _Setup:
    """With sensors of displacement, velocity and acceleration on all bodies, and no loop."""
    system = setup.true
    every = tuple(
        s._replace(name=f"{kind} {b}", body=b, kind=kind)
        for kind in ("displacement", "velocity", "acceleration")
        for b in system.bodies
        for s in system.sensors[:1]
    )
    return dataclasses.replace(setup, true=system._replace(sensors=every), loop=None)


def _noise(run: _Run, part: float) -> np.ndarray:
    return part * run.y[run.before :].std(axis=0)


def _own(found: Severity, kind: str) -> float:
    return found.gap if kind in ABSORBED else found.gap_recalibrated


class Sized(NamedTuple):
    """An effect with its size, its severity alone, and the steps that resolve it."""

    effect: Effect
    severity: Severity
    target: float
    steps: int


def _sized(
    setup: _Setup, drawn: Drawn, noise: float, target: float, seed: list[int], scale: Scale
) -> Sized | None:
    """The size whose gap is nearest to the target, on a short record; None where it cannot be seen."""
    low, high = np.log(LIMITS.get(drawn.kind, ANY))
    size, best = 0.5 * (low + high), None
    for _ in range(TRIES):
        given = parameters(drawn.kind, float(np.exp(size)), scale, drawn.shape)
        effect = Effect(drawn.kind, drawn.where, drawn.ends, given)
        steps = steps_of(setup.true, (effect,))
        run = _record(setup, (effect,), seed, SHORT, setup.level, steps, 0.0)
        found = _judged(setup, run, noise)
        # beyond the target, or beyond what a response may change by
        much = found is None or _own(found, drawn.kind) > target or found.change > CHANGES[1]
        if found is not None and (
            best is None or _miss(found, drawn, target) < _miss(best[1], drawn, target)
        ):
            best = Sized(effect, found, target, steps)
        if best is not None and _miss(best.severity, drawn, target) < 0.15:
            break
        low, high = (low, size) if much else (size, high)
        size = 0.5 * (low + high)
    if best is None or best.severity.change < 0.5 * CHANGES[0] or _own(best.severity, drawn.kind) < 0.2:
        return None
    return best


def _miss(found: Severity, drawn: Drawn, target: float) -> float:
    """How far from the target, with a response that changes too much counting more."""
    own = _own(found, drawn.kind)
    over = max(np.log(max(found.change, 1e-9) / CHANGES[1]), 0.0)
    return abs(np.log(max(own, 1e-9) / target)) + 2 * over


def _judged(setup: _Setup, run: _Run, noise: float) -> Severity | None:
    y = run.y
    if not _bounded(y) or np.any(y[run.before :].std(axis=0) <= 1e-9 * np.abs(y).max(axis=0)):
        return None  # runs away, or sticks for good
    return severity(setup.true, run.u, y, _noise(run, noise), run.before)


def _bounded(y: np.ndarray) -> bool:
    return bool(np.all(np.isfinite(y)) and np.abs(y).max() < 1e100)


def _resolved(
    setup: _Setup, effects: tuple[Effect, ...], steps: int, noise: float, seed: list[int]
) -> tuple[int, float]:
    """Steps whose halving changes the readings by little of the noise, and that change."""
    if steps == 1:
        return 1, 0.0
    coarse = _record(setup, effects, seed, SHORT // 2, setup.level, steps, 0.0)
    while True:
        fine = _record(setup, effects, seed, SHORT // 2, setup.level, 2 * steps, 0.0)
        change = float(np.sqrt(np.mean(((fine.y - coarse.y) / _noise(fine, noise)) ** 2)))
        if change < EXACT or 2 * steps > MOST_STEPS or not np.isfinite(change):
            return steps, change
        steps, coarse = 2 * steps, fine


def _of_record(effects: tuple[Effect, ...], rng: np.random.Generator, length: float) -> tuple[Effect, ...]:
    """What differs between records: phases of what is not bound to the experiment, the instant of a change."""
    found = []
    for effect in effects:
        p = dict(effect.parameters)
        if effect.kind in ("periodic_disturbance", "parametric_stiffness"):
            p["phase"] = float(rng.uniform(-np.pi, np.pi))
        if "instant" in p:
            p["instant"] = length * float(rng.uniform(0.3, 0.7))
        found.append(effect._replace(parameters=p))
    return tuple(found)


def _on_grid(effect: Effect, h: float) -> Effect:
    """Delays are whole steps of the simulation."""
    if "delay" not in effect.parameters:
        return effect
    return effect._replace(parameters={"delay": h * max(round(effect.parameters["delay"] / h), 1)})


def _coloured(rng: np.random.Generator, shape: tuple[int, int], pole: float) -> np.ndarray:
    """Noise of unit variance, white or autoregressive of first order."""
    white = rng.standard_normal((shape[0] + 500, shape[1]))
    return np.sqrt(1 - pole**2) * scipy.signal.lfilter([1.0], [1.0, -pole], white, axis=0)[500:]


def _effects(rng: np.random.Generator, case: Planned, setup: _Setup, seed: list[int]) -> list[Sized] | None:
    """All effects of a case, each with its size; None where one has no place or cannot be seen."""
    if not case.kinds:
        return []
    plain = _record(_everywhere(setup), (), seed, SHORT, setup.level, 1, 0.0)
    found: list[Sized] = []
    for kind in case.kinds:
        place = place_of(rng, kind, setup.nominal)
        # a refit takes up most of what a law does: less of the response has to be left than it changed by
        low = max(GAPS[0], CHANGES[0] / case.noise * (1.0 if kind in ABSORBED else 0.3))
        target = float(np.exp(rng.uniform(np.log(low), np.log(min(GAPS[1], CHANGES[1] / case.noise)))))
        drawn = shape(rng)
        if place is None:
            return None
        scale = _scale(setup, *place, plain, SHORT * setup.true.dt)
        sized = _sized(setup, Drawn(kind, *place, drawn), case.noise, target, seed, scale)
        if sized is None:
            return None
        found.append(sized)
    return found


def drawn_case(which: str, case: Planned, samples: tuple[int, int] = SAMPLES) -> Case:
    """Of a set, by its plan.

    Args:
        which: one of `SETS`.
        case: of `plan`.
        samples: of the two records.
    """
    for attempt in range(DRAWS):
        seed = [SETS[which], 2, case.number, attempt]
        rng = np.random.default_rng(seed)
        setup = _setup(rng, case)
        sized = _effects(rng, case, setup, [*seed, 1])
        if sized is None:
            continue
        effects = tuple(s.effect for s in sized)
        least = max([1, *(s.steps for s in sized)])
        steps, change = _resolved(setup, effects, least, case.noise, [*seed, 1])
        effects = tuple(_on_grid(e, setup.true.dt / steps) for e in effects)
        made = _made(case, setup, effects, steps, seed, samples)
        if made is not None and not (which in REFITTED and _taken_up(case, setup, made)):
            return _labelled(case, setup, sized, made, steps, change, attempt)
    raise RuntimeError(f"case {case.number} of {which}: {case.kinds} cannot be seen in {DRAWS} systems")


class _Made(NamedTuple):
    runs: tuple[_Run, ...]
    effects: tuple[tuple[Effect, ...], ...]  # of each record
    std: np.ndarray
    noisy: tuple[np.ndarray, ...]
    severities: tuple[Severity, ...]
    each: tuple[float, ...]  # gap of each effect in the first record, beside the others


def _taken_up(case: Planned, setup: _Setup, made: _Made) -> bool:
    """Whether other numbers of the model do what a single effect does, as far as the noise lets one tell."""
    run, alone = made.runs[0], len(case.kinds) == 1 and case.kinds[0] not in ABSORBED
    return alone and gap_left(setup.true, run.u[run.before :], run.y[run.before :], made.std) < GAPS[0]


def _rated(effects: tuple[Effect, ...], setup: _Setup, samples: int) -> tuple[Effect, ...]:
    """Slow changes by as much over the first record as they had over the short one."""
    ratio = SHORT / samples
    return tuple(
        e._replace(parameters={"rate": e.parameters["rate"] * ratio})
        if e.kind == "time_varying_stiffness"
        else e
        for e in effects
    )


def _made(
    case: Planned,
    setup: _Setup,
    effects: tuple[Effect, ...],
    steps: int,
    seed: list[int],
    samples: tuple[int, int],
) -> _Made | None:
    """Both records, noise added; None if the motion grows without bound or becomes too unlike."""
    rng = np.random.default_rng([*seed, 2])
    effects = _rated(effects, setup, samples[0])
    own = tuple(_of_record(effects, rng, n * setup.true.dt) for n in samples)
    level, runs = setup.level, []
    fed_back = 0.0
    if setup.loop is not None:  # the loop sees the noise, whose level follows from a motion without
        first = _record(setup, own[0], [*seed, 3], min(samples[0], SHORT), level, steps, 0.0)
        fed_back = float(_noise(first, case.noise)[setup.loop.sensor])
    for i, n in enumerate(samples):
        runs.append(_record(setup, own[i], [*seed, 3 + i], n, level * setup.ratio**i, steps, fed_back))
    if not all(_bounded(r.y) for r in runs):
        return None
    std = _noise(runs[0], case.noise)
    severities = tuple(severity(setup.true, r.u, r.y, std, r.before) for r in runs)
    if case.kinds and severities[0].change > 3 * CHANGES[1] and case.kinds[0] not in ABSORBED:
        return None
    each = tuple(_beside_others(setup, runs[0], own[0], i, std, steps) for i in range(len(effects)))
    if min(each, default=GAPS[0]) < GAPS[0]:
        return None
    noisy = []
    for i, run in enumerate(runs):
        u, y = run.u[run.before :], run.y[run.before :]
        noise = std * _coloured(np.random.default_rng([*seed, 5 + i]), y.shape, case.colour)
        if setup.loop is not None:  # what the loop saw is what is recorded
            same = np.random.default_rng([*seed, 3 + i])
            signal_of(setup.excitation, same, len(run.u), setup.true.dt, setup.band)
            noise[:, setup.loop.sensor] = fed_back * same.standard_normal(len(run.u))[run.before :]
        noisy.append(np.column_stack([u, y + noise]))
    return _Made(tuple(runs), own, std, tuple(noisy), severities, each)


def _beside_others(
    setup: _Setup, run: _Run, effects: tuple[Effect, ...], number: int, std: np.ndarray, steps: int
) -> float:
    """What an effect does where the others act already: of two that act alone one may do nothing beside the other."""
    kind = effects[number].kind
    if len(effects) == 1:
        return _own(severity(setup.true, run.u, run.y, std, run.before), kind)
    others = tuple(e for i, e in enumerate(effects) if i != number)
    with np.errstate(all="ignore"):
        y = respond(setup.true, others, run.u, before=run.before, steps=steps).y
    return _own(severity(setup.true, run.u, run.y, std, run.before, y), kind) if _bounded(y) else np.inf


def _labelled(
    case: Planned, setup: _Setup, sized: list[Sized], made: _Made, steps: int, change: float, attempt: int
) -> Case:
    n = len(setup.nominal.sensors)
    alone = [_own(s.severity, s.effect.kind) for s in sized]
    label: dict[str, Any] = {
        "case": case.number,
        "truth": "none" if not sized else "unknown" if case.kinds[0] in OUTSIDE else "effect",
        "effects": [
            {
                "kind": e.kind,
                "kinds_right": list(UNLIKE.get(e.kind, () if e.kind in OUTSIDE else (e.kind,))),
                "place": e.place,
                "parameters": [x[i].parameters for x in made.effects],
                "gap": made.each[i],  # in the first record, beside the others
                "gap_alone": alone[i],
                "target": sized[i].target,
            }
            for i, e in enumerate(made.effects[0])
        ],
        "severity": [s._asdict() for s in made.severities],
        "noise": case.noise,
        "noise_std": made.std.tolist(),
        "colour": case.colour,
        "family": case.family,
        "excitation": setup.excitation,
        "level_ratio": setup.ratio,
        "sensors": n,
        "one_sensor": n == 1,
        "steps": steps,
        "discretization": change,
        "attempt": attempt,
        "nominal": setup.nominal._asdict(),
        "true": setup.true._asdict(),
        "heldout_floor": [float(x) for x in made.std / made.noisy[1][:, 1:].std(axis=0)],
    }
    return Case(setup.nominal, made.noisy, label)
