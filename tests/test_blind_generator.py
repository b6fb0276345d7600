"""The generator of the blind benchmark: independent of the library, right, reproducible, and with labels sealed."""

import ast
import json
import sys
from collections import Counter
from pathlib import Path

import effects_truth
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import chirp

FOLDER = Path(__file__).parents[1] / "benchmarks" / "blind"
sys.path.insert(0, str(FOLDER))
import draw  # pyright: ignore[reportMissingImports]  # noqa: E402
import equivalent  # pyright: ignore[reportMissingImports]  # noqa: E402
import generate  # pyright: ignore[reportMissingImports]  # noqa: E402
import laws  # pyright: ignore[reportMissingImports]  # noqa: E402
import recalibrate  # pyright: ignore[reportMissingImports]  # noqa: E402
import score  # pyright: ignore[reportMissingImports]  # noqa: E402
import severity  # pyright: ignore[reportMissingImports]  # noqa: E402
import systems  # pyright: ignore[reportMissingImports]  # noqa: E402
from plan import SETS, plan  # pyright: ignore[reportMissingImports]  # noqa: E402
from truth import Loop, respond  # pyright: ignore[reportMissingImports]  # noqa: E402

DT, NAMES = 0.01, ("b1", "b2", "b3")
ENDS = ("ground", *NAMES)
CHAIN = systems.System(
    "chain",
    NAMES,
    (1.0, 1.2, 0.9),
    tuple(
        systems.Connection(f"c{i}", (ENDS[i], ENDS[i + 1]), k, c)
        for i, (k, c) in enumerate(((1500.0, 3.0), (1200.0, 2.0), (1800.0, 2.5)))
    ),
    (systems.Input("u", "b1"),),
    (
        systems.Sensor("s0", "b1", "acceleration"),
        systems.Sensor("s1", "b2", "velocity"),
        systems.Sensor("s2", "b3", "displacement"),
    ),
    DT,
)
MASS = systems.System(
    "mass",
    ("b1",),
    (1.0,),
    (systems.Connection("c", ("ground", "b1"), 900.0, 1.0),),
    (systems.Input("u", "b1"),),
    tuple(systems.Sensor(k, "b1", k) for k in ("displacement", "velocity", "acceleration")),
    DT,
)
CASES = {
    "mass_error": {"factor": 1.1},
    "stiffness_error": {"factor": 0.9},
    "damping_error": {"factor": 2.0},
    "missing_connection": {"stiffness": 100.0, "damping": 1.0},
    "missing_mode": {"mass": 0.2, "stiffness": 100.0, "damping": 0.1},
    "coulomb_friction": {"force": 3.0},
    "stribeck_friction": {"force": 2.0, "static_force": 4.0, "velocity": 0.1},
    "quadratic_damping": {"coefficient": 10.0},
    "cubic_stiffness": {"coefficient": 1e6},
    "quadratic_stiffness": {"coefficient": 2e4},
    "bilinear_stiffness": {"stiffness": 300.0},
    "backlash": {"half_gap": 0.004},
    "end_stop": {"stiffness": 3000.0, "clearance": 0.01},
    "hysteresis": {"stiffness": 500.0, "beta": 100.0, "gamma": 50.0, "exponent": 1.5},
    "cogging_ripple": {"amplitude": 3.0, "wavenumber": 200.0, "phase": 0.5},
    "constant_load": {"force": 3.0},
    "periodic_disturbance": {"amplitude": 3.0, "frequency_hz": 4.0, "phase": 0.4},
    "time_varying_stiffness": {"rate": 200.0},
    "sensor_gain": {"factor": 1.1},
    "sensor_bias": {"offset": 1.0},
    "sensor_delay": {"delay": 0.013},
    "sensor_lag": {"time_constant": 0.02},
    "input_gain": {"factor": 1.1},
    "input_delay": {"delay": 0.013},
    "actuator_lag": {"time_constant": 0.02},
    "actuator_saturation": {"limit": 8.0},
}
# The smooth and the linear ones take no time at all; the reference goes from event to event for the others.
SLOW = (*laws.FRICTION, *laws.KINKED, "hysteresis", "input_delay", "sensor_delay")


def force(samples: int, seed: int = 0) -> np.ndarray:
    """A held random force, 10 N rms, slow enough to be like one of the benchmark's."""
    white = np.random.default_rng(seed).standard_normal(samples + 3)
    return 10 * np.convolve(white, np.ones(4) / 2, mode="valid")


def off(y: np.ndarray, reference: np.ndarray) -> float:
    """Relative rms of the worst column."""
    return float(np.sqrt(((y - reference) ** 2).mean(0) / (reference**2).mean(0)).max())


def local_imports(name: str) -> set[str]:
    """Modules that a script of the folder imports, those of the folder followed."""
    found, left = set(), [name]
    while left:
        tree = ast.parse((FOLDER / f"{left.pop()}.py").read_text())
        names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        left += [x for x in names - found if (FOLDER / f"{x}.py").exists()]
        found |= names
    return found


def test_the_generator_imports_nothing_of_the_library():
    roots = {x.split(".")[0] for x in local_imports("generate")}
    outside = {x for x in roots if not (FOLDER / f"{x}.py").exists()} - set(sys.stdlib_module_names)
    assert outside == {"numpy", "scipy"}


def test_every_kind_of_the_contract_is_possible():
    assert len(laws.CATALOGUE) == 26
    assert set(CASES) == set(laws.CATALOGUE)


def test_without_effects_it_is_the_matrix_exponential():
    M, damping, K = systems.matrices(CHAIN)
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ K, -inverse @ damping]])
    B = np.concatenate([np.zeros(3), inverse[:, 0]])
    step = expm(np.block([[A, B[:, None]], [np.zeros((1, 7))]]) * DT)
    x, u, found = np.zeros(6), force(1000), []
    for push in u:
        found.append([A[3] @ x + B[3] * push, x[4], x[2]])
        x = step[:6, :6] @ x + step[:6, 6] * push
    assert off(respond(CHAIN, (), u).y, np.array(found)) < 1e-12


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k in SLOW)) for k in CASES])
def test_effects_agree_with_integration_from_event_to_event(kind):
    at: tuple[str, tuple[str, ...], object] = ("between", ("b1", "b2"), (0, 1))
    if kind in ("mass_error", "missing_mode", *laws.FORCES):
        at = ("body", ("b2",), 1)
    elif kind in laws.SENSOR:
        at = ("sensor", ("s1",), 1)
    elif kind in laws.INPUT:
        at = ("input", ("u",), 0)
    elif kind == "missing_connection":
        at = ("between", ("ground", "b3"), (effects_truth.GROUND, 2))
    where, ends, place = at
    u = force(120)
    M, damping, K = systems.matrices(CHAIN)
    sensors = ((0, "acceleration"), (1, "velocity"), (2, "displacement"))
    chain = effects_truth.Chain(M, damping, K, 0, sensors)
    reference = effects_truth.Truth(chain, kind, place, CASES[kind], DT).run(u)
    found = respond(CHAIN, (systems.Effect(kind, where, ends, CASES[kind]),), u).y
    plain = respond(CHAIN, (), u).y
    assert off(plain, reference) > 0.02, "the effect does too little to be checked"
    assert off(found, reference) < (1e-3 if kind in laws.FRICTION else 1e-4)


def radau(system, law, u: np.ndarray, states: int = 0, method: str = "Radau") -> np.ndarray:
    """A mass with a force law(t, d, v, z) -> (F, z'), by scipy from sample to sample: d, v, a."""
    (m,), (c,) = system.mass, system.connections
    x, found = np.zeros(2 + states), []

    def rate(t: float, x: np.ndarray, push: float) -> np.ndarray:
        f, dz = law(t, x[0], x[1], x[2:])
        return np.array([x[1], (push - c.stiffness * x[0] - c.damping * x[1] - f) / m, *dz])

    for k, push in enumerate(u):
        found.append([x[0], x[1], rate(k * DT, x, push)[1]])
        span = (k * DT, (k + 1) * DT)
        x = solve_ivp(rate, span, x, method, rtol=1e-9, atol=1e-12, args=(push,)).y[:, -1]
    return np.array(found)


OUTSIDE = {
    "hertz_contact": {"coefficient": 1e4, "gap": 0.004},
    "one_sided_damping": {"coefficient": 8.0},
    "displacement_damping": {"coefficient": 300.0},
    "self_excitation": {"coefficient": 3.0, "limit": 0.02},
    "switching_stiffness": {"stiffness": 300.0, "instant": 0.3, "rise": 0.02},
    "parametric_stiffness": {"stiffness": 200.0, "frequency_hz": 7.0, "phase": 0.3},
    "fifth_order_stiffness": {"coefficient": 1.0, "limit": 0.02},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", OUTSIDE)
def test_laws_outside_the_catalogue_agree_with_radau(kind):
    p = OUTSIDE[kind]

    def law(t, d, v, z):
        f = {
            "hertz_contact": lambda: p["coefficient"] * max(d - p["gap"], 0) ** 1.5,
            "one_sided_damping": lambda: p["coefficient"] * max(v, 0),
            "displacement_damping": lambda: p["coefficient"] * d * abs(v),
            "self_excitation": lambda: p["coefficient"] * (d**2 / p["limit"] ** 2 - 1) * v,
            "switching_stiffness": lambda: p["stiffness"] * d * np.clip((t - 0.3) / 0.02, 0, 1),
            "parametric_stiffness": lambda: p["stiffness"] * d * np.sin(14 * np.pi * t + 0.3),
            "fifth_order_stiffness": lambda: (
                p["coefficient"] * ((d / p["limit"]) ** 5 - (d / p["limit"]) ** 3)
            ),
        }[kind]()
        return f, ()

    u = force(100)
    found = respond(MASS, (systems.Effect(kind, "between", ("ground", "b1"), p),), u).y
    reference = radau(MASS, law, u)
    assert off(respond(MASS, (), u).y, reference) > 0.02
    assert off(found, reference) < 1e-4


@pytest.mark.slow
def test_lugre_agrees_with_radau():
    p = {
        "force": 3.0,
        "static_force": 5.0,
        "velocity": 0.05,
        "bristle_stiffness": 6000.0,
        "bristle_damping": 0.5,
    }

    def law(t, d, v, z):
        level = 3 + 2 * np.exp(-((v / 0.05) ** 2))
        dz = v - 6000 * abs(v) * z[0] / level
        return 6000 * z[0] + 0.5 * dz, (dz,)

    u = force(100)
    found = respond(MASS, (systems.Effect("lugre", "between", ("ground", "b1"), p),), u).y
    assert off(found, radau(MASS, law, u, 1)) < 1e-3


@pytest.mark.slow
def test_iwan_agrees_with_an_explicit_method():
    limits = np.array(laws.iwan_limits(0.005, 3.0))

    def law(t, d, v, z):
        slides = (np.abs(z) >= limits) & (v * z > 0)
        return 50 * np.clip(z, -limits, limits).sum(), np.where(slides, 0.0, v)

    u = force(100)
    p = {"stiffness": 400.0, "yielding": 0.005, "spread": 3.0}
    found = respond(MASS, (systems.Effect("iwan", "between", ("ground", "b1"), p),), u).y
    assert off(respond(MASS, (), u).y, found) > 0.02
    assert off(found, radau(MASS, law, u, 8, "RK23")) < 1e-3


@pytest.mark.slow
def test_impacts_agree_with_radau_from_event_to_event():
    u, gap, restitution = force(100), 0.012, 0.5
    p = {"gap": gap, "restitution": restitution}
    found = respond(MASS, (systems.Effect("impacts", "between", ("ground", "b1"), p),), u).y
    x, reference, hits = np.zeros(2), [], 0

    def rate(t, x, push):
        return np.array([x[1], push - 900 * x[0] - x[1]])

    def reached(t, x, push):
        return x[0] - gap

    reached.terminal, reached.direction = True, 1
    for k, push in enumerate(u):
        reference.append([x[0], x[1], rate(0.0, x, push)[1]])
        t = k * DT
        while (k + 1) * DT - t > 1e-12:
            run = solve_ivp(
                rate, (t, (k + 1) * DT), x, "Radau", rtol=1e-9, atol=1e-13, args=(push,), events=reached
            )
            t, x = run.t[-1], run.y[:, -1]
            if run.status == 1:
                x, hits = np.array([gap, -restitution * x[1]]), hits + 1
    assert hits > 2
    assert (
        off(found[:, :1], np.array(reference)[:, :1]) < 1e-3
    )  # a speed may be read on either side of a jump


def test_a_loop_feeds_back_what_is_measured():
    u, loop = force(400), Loop(1, 2.0, 0.0)
    noise = 0.01 * np.random.default_rng(1).standard_normal(400)
    closed = respond(CHAIN, (), u, loop=loop, noise=noise)
    np.testing.assert_allclose(closed.u, u - 2 * (closed.y[:, 1] + noise), atol=1e-12)
    np.testing.assert_allclose(respond(CHAIN, (), closed.u).y, closed.y, atol=1e-12)


def test_motion_ahead_of_the_record_is_the_same_motion():
    u = force(300)
    effect = systems.Effect("periodic_disturbance", "body", ("b2",), CASES["periodic_disturbance"])
    period = 1 / CASES["periodic_disturbance"]["frequency_hz"]
    at = round(period / DT)
    whole, later = (respond(CHAIN, (effect,), u, before=b).y for b in (0, at))
    np.testing.assert_allclose(whole, later, atol=1e-9)


@pytest.mark.parametrize("which", SETS)
def test_the_plan_holds_every_kind_often_enough(which):
    planned = plan(which, 240)
    counts = Counter(k for case in planned for k in case.kinds)
    assert min(counts[k] for k in laws.CATALOGUE) >= 6
    assert min(counts[k] for k in (*laws.OUTSIDE, *laws.UNLIKE)) >= 2
    assert Counter(len(x.kinds) for x in planned) == {0: 48, 1: 144, 2: 48}
    assert sum(x.kinds[:1] != () and x.kinds[0] in laws.OUTSIDE for x in planned) == 36
    assert all(len(set(x.kinds)) == len(x.kinds) for x in planned)


def test_sets_have_nothing_in_common():
    assert plan("dev", 24) == plan("dev", 240)[:24]
    each = [tuple(x.kinds for x in plan(which, 240)) for which in SETS]
    assert len(set(each)) == len(each)


def small(which: str, wanted) -> draw.Case:
    """The first planned case of a sort, on few samples."""
    planned = next(x for x in plan(which, 240) if wanted(x))
    return draw.drawn_case(which, planned, (600, 300))


def test_draws_are_reproducible_and_labels_are_apart(tmp_path):
    clipped = lambda x: x.kinds == ("actuator_saturation",)  # noqa: E731
    first, again = (small("dev", clipped) for _ in range(2))
    for a, b in zip(first.records, again.records, strict=True):
        np.testing.assert_array_equal(a, b)
    generate.write_case(tmp_path, 7, first)
    files = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert files == [
        "cases/0007/model.toml",
        "cases/0007/run1.csv",
        "cases/0007/run2.csv",
        "labels/0007.json",
    ]
    told = "".join((tmp_path / f).read_text() for f in files[:3])
    assert "saturation" not in told
    label = json.loads((tmp_path / files[3]).read_text())
    assert label["effects"][0]["kind"] == "actuator_saturation"
    assert equivalent.system_of(label["nominal"]) == first.nominal


def test_the_library_reads_what_is_written(tmp_path):
    import jaxsid

    case = small("dev", lambda x: x.kinds == () and x.family == "drive")
    generate.write_case(tmp_path, 1, case)
    model = jaxsid.read_model(tmp_path / "cases/0001/model.toml")
    record = jaxsid.read_record(tmp_path / "cases/0001/run1.csv", model)
    np.testing.assert_allclose(np.asarray(record.u)[:, 0], case.records[0][:, 0], rtol=1e-8)
    np.testing.assert_allclose(np.asarray(record.y), case.records[0][:, 1:], rtol=1e-8, atol=1e-300)


@pytest.mark.parametrize("sensor", [0, 1])
def test_a_sampled_loop_that_runs_away_is_told(sensor):
    """By its poles, against the motion itself; a free axis under feedback of its velocity drifts, no more."""
    drive = np.random.default_rng(0).standard_normal(300)
    told, grown = [], []
    for rate in 10.0 ** np.arange(0, 4):
        loop = Loop(sensor, rate, 0.3 * rate if sensor == 0 else 0.0)
        told.append(draw._grows(MASS, loop))
        y = np.abs(respond(MASS, (), drive, loop=loop).y[:, 1])
        grown.append(bool(y[-50:].max() > 100 * y[:50].max()))
    assert told == grown
    assert {True, False} == set(told)
    free = MASS._replace(connections=(systems.Connection("c", ("ground", "b1"), 0.0, 1.0),))
    assert not draw._grows(free, Loop(1, 1.0, 0.0))


def labelled(kind: str, place: dict, sensors: tuple = CHAIN.sensors, **more) -> dict:
    """A label as `score` reads it."""
    system = CHAIN._replace(sensors=sensors)
    effect = {"kind": kind, "kinds_right": [kind], "place": place, "gap_alone": 5.0}
    return {
        "effects": [effect],
        "true": json.loads(json.dumps(system._asdict())),
        "one_sensor": len(sensors) == 1,
        "truth": "effect",
        "noise": 0.01,
        **more,
    }


def test_only_exact_equivalences_count():
    right = equivalent.right_answers
    own = labelled("input_delay", {"input": "u"})
    assert right(own, 0) == {("input_delay", "input", frozenset({"u"}))}
    one = labelled("input_delay", {"input": "u"}, CHAIN.sensors[:1])
    assert right(one, 0) == {
        ("input_delay", "input", frozenset({"u"})),
        ("sensor_delay", "sensor", frozenset({"s0"})),
    }
    # one displacement: any constant load gives it an offset; two tell loads apart
    load = right(labelled("constant_load", {"body": "b1"}), 0)
    assert {x[0] for x in load} == {"constant_load", "sensor_bias"}
    assert len(load) == 4
    two = (systems.Sensor("a", "b1", "displacement"), systems.Sensor("b", "b3", "displacement"))
    assert len(right(labelled("constant_load", {"body": "b1"}, two), 0)) == 1
    assert equivalent.same_place(labelled("random_force", {"body": "b1"}), 0, {"input": "u"})
    assert not equivalent.same_place(labelled("random_force", {"body": "b2"}), 0, {"input": "u"})


def test_a_sinusoid_on_the_far_side_of_all_sensors_may_act_on_any_body_there():
    def at(body: str, *sensed: str, kind: str = "periodic_disturbance", effects: int = 1) -> set[str]:
        label = labelled(kind, {"body": body}, tuple(systems.Sensor(b, b, "acceleration") for b in sensed))
        label["effects"] *= effects
        return {b for _, _, names in equivalent.right_answers(label, 0) for b in names}

    assert at("b1", "b2", "b3") == at("b2", "b2", "b3") == {"b1", "b2"}
    assert at("b3", "b2", "b3") == {"b3"}
    assert at("b1", "b1", "b3") == {"b1"}
    assert at("b3", "b1") == {"b1", "b2", "b3"}
    # a body's mass is told by its own resonance; beside another effect motions are no sums
    assert at("b1", "b2", "b3", kind="missing_mode") == {"b1"}
    assert at("b1", "b2", "b3", effects=2) == {"b1"}


def test_what_is_said_of_an_answer_is_said_of_all_that_no_record_tells_from_it():
    place, sensor = {"input": "u"}, {"sensor": "s0"}
    at = [("input_delay", place, 0.5, 1), ("sensor_delay", sensor, 0.4, 1), ("sensor_lag", sensor, 0.05, 1)]
    at.append(("sensor_delay", sensor, 0.04, 2))  # a second effect is another answer
    ranked = [{"kind": k, "place": p, "probability": x, "round": i} for k, p, x, i in at]
    for sensors, said in (CHAIN.sensors[:1], 0.9), (CHAIN.sensors, 0.5):
        # whatever is true
        label = labelled("cubic_stiffness", {"between": ["b1", "b2"]}, sensors)
        case = lambda of, label=label: score.Scored(label, {"effects": ranked, "selected": of}, 1.0)  # noqa: E731
        assert score.said_of_first(case(ranked[:1])) == pytest.approx(said)
        # beside another effect it matters on which side of it
        assert score.said_of_first(case([ranked[0], *ranked[:1]])) == pytest.approx(0.5)


def test_scores_of_a_few_answers():
    label = labelled("cubic_stiffness", {"between": ["b1", "b2"]})
    good = {"kind": "cubic_stiffness", "place": {"between": ["b2", "b1"]}, "probability": 0.9}
    wrong = {"kind": "backlash", "place": {"between": ["b1", "b2"]}, "probability": 0.8}
    found = lambda *effects: score.Scored(  # noqa: E731
        label, {"verdict": "effect", "effects": list(effects), "closure": {"fraction": 0.9}}, 1.0
    )
    none = score.Scored({"effects": [], "truth": "none", "one_sensor": False}, {"verdict": "effect"}, 1.0)
    failed = score.Scored(label, {}, 1.0)
    result = score.scored([found(good, wrong), found(wrong, good), none, failed])
    assert result["first"]["hits"] == 1
    assert result["first_two"]["hits"] == 2
    assert result["first"]["cases"] == 3
    assert result["false_alarms"]["share"] == 1.0
    assert result["failures"] == 1
    assert result["calibration"]["error"] == pytest.approx((0.1 + 0.8) / 2)
    assert result["confusion"]["cubic_stiffness"] == {"cubic_stiffness": 1, "backlash": 1, "failure": 1}
    assert "two effects, both found | no case" in score.table(result)


def test_wilson_interval():
    low, high = score.wilson(9, 10)
    np.testing.assert_allclose([low, high], [0.5958, 0.9821], atol=1e-4)


def test_what_other_numbers_do_as_well_is_no_gap_however_far_it_shifts_a_mode():
    """A spring to the ground is one number more of a single mass's spring, and more than a linearized refit follows."""
    u = np.random.default_rng(3).standard_normal(1500)
    std = np.array([1e-4, 3e-3, 0.1])

    def gaps(effect):
        y = respond(MASS, (effect,), u, before=0, steps=24).y
        linearized = severity.severity(MASS, u, y, std, 0).gap_recalibrated
        return linearized, recalibrate.gap_left(MASS, u, y, std)

    where = "between", ("ground", "b1")
    linearized, left = gaps(systems.Effect("missing_connection", *where, {"stiffness": 60.0, "damping": 0.3}))
    assert linearized > 1.0 > 0.05 > left
    linearized, left = gaps(systems.Effect("cubic_stiffness", *where, {"coefficient": 3e5}))
    assert left > 0.3 * linearized > 0.3


def test_numbers_of_a_narrow_mode_are_found_though_mass_and_stiffness_do_nearly_the_opposite():
    u = chirp(DT * np.arange(3000), 1.0, DT * 3000, 20.0)
    narrow = MASS._replace(connections=(systems.Connection("c", ("ground", "b1"), 900.0, 0.15),))
    shifted = systems.recalibrated_by(narrow, systems.numbers(narrow) * np.array([1.0, 0.999, 1.0]))
    y = respond(shifted, (), u, before=0, steps=1).y
    std = 0.01 * y.std(axis=0)
    by_itself = np.sqrt(np.mean((recalibrate.fitted_start(narrow, u, y).residual / std) ** 2))
    assert by_itself > 1.0 > 1e-3 > recalibrate.gap_left(narrow, u, y, std)
