"""Refinement of models with effects, on records of an independent simulation."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from effects_truth import Chain, Truth

import jaxsid
from jaxsid.checks import InputError
from jaxsid.mechanics.lumped import Connection, Effect, Input, Sensor, lumped_model

DT = 2e-3
MASS, STIFFNESS, DAMPING = [1.0, 1.2], [900.0, 700.0], [3.0, 2.0]
NAMES = ("b1.mass", "b2.mass", "c1.damping", "c2.damping", "c1.stiffness", "c2.stiffness")


def chain(effects, wrong=1.0, seed=3):
    factor = lambda x: np.array(x) * (1 + wrong * np.random.default_rng(seed).uniform(-1, 1, len(x)))  # noqa: E731
    return lumped_model(
        ("b1", "b2"),
        factor(MASS),
        factor(STIFFNESS),
        factor(DAMPING),
        connections=[Connection("c1", ("ground", "b1")), Connection("c2", ("b1", "b2"))],
        inputs=[Input("drive", "b1")],
        sensors=[Sensor("s0", "b1", "acceleration"), Sensor("s1", "b2", "displacement")],
        effects=effects,
    )


def between(kind, place, **parameters):
    return Effect(kind, (("between", place),), parameters)


def truth(kind, place, parameters, samples, seed=0, noise=0.0):
    """A record of the two masses with one effect, from scipy, with white noise on the sensors."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(samples, DT)
    u = np.fft.irfft(np.where((f > 0.5) & (f < 15), np.exp(2j * np.pi * rng.random(len(f))), 0), samples)
    u = 12 * u / u.std()
    k, d = STIFFNESS, DAMPING
    matrix = lambda x: np.array([[x[0] + x[1], -x[1]], [-x[1], x[1]]])  # noqa: E731
    sensors = ((0, "acceleration"), (1, "displacement"))
    y = Truth(Chain(np.diag(MASS), matrix(d), matrix(k), 0, sensors), kind, place, parameters, DT).run(u)
    y = y + noise * y.std(axis=0) * rng.normal(size=y.shape)
    return jaxsid.Record(u[:, None], y, DT, inputs=("drive",), outputs=("s0", "s1"))


@pytest.fixture(scope="module")
def rubbing():
    return truth("coulomb_friction", (-1, 0), {"force": 3.0}, 2400, noise=0.01)


def check(found, expected, deviations=4.5):
    for name, value in expected.items():
        error, std = abs(float(found.value(name)) - value), float(found.deviation(name))
        assert 0 < std < 0.1 * abs(value), name
        assert error < deviations * std, (name, error, std)


TRUE = dict(zip(NAMES, [*MASS, *DAMPING, *STIFFNESS], strict=True))
FRICTION = "coulomb_friction(ground, b1).force"


@pytest.mark.slow
def test_friction_and_all_elements_from_wrong_values(rubbing):
    model = chain([between("coulomb_friction", ("ground", "b1"), force=1.5)], wrong=0.3)
    found = jaxsid.refine(model, rubbing)
    check(found, {**TRUE, FRICTION: 3.0})
    # at a reversal the acceleration jumps by 2 F / m; one sample may fall on its other side
    y = np.asarray(rubbing.y)
    spike = np.array([2 * 3.0 / MASS[0] / np.linalg.norm(y[:, 0]), 0.0])
    assert (np.asarray(found.after) > 0.009).all()
    assert (np.asarray(found.after) < np.hypot(0.011, spike)).all()
    assert found.validation is not None
    assert found.validation.better
    assert (np.asarray(found.validation.refined) < np.hypot(0.013, 2 * spike)).all()
    assert 0.8 < float(found.misfit) < 1.2
    assert found.warnings == ()
    assert found.residuals is not None
    white = np.abs(np.asarray(found.residuals.autocorrelation)[1:]) < found.residuals.white_limit
    assert white.mean() > 0.95
    # the refined model holds its effect and simulates
    again = np.asarray(jaxsid.simulate(found.model, rubbing, initial="estimate"))
    assert (np.sqrt(((again - y) ** 2).mean(axis=0)) < np.hypot(0.012, 2 * spike) * y.std(axis=0)).all()


def test_friction_beside_known_masses_and_dampers(rubbing):
    model = chain([between("coulomb_friction", ("ground", "b1"), force=1.5)], wrong=0.0)
    part = jaxsid.Record(rubbing.u[:400], rubbing.y[:400], DT, inputs=("drive",), outputs=("s0", "s1"))
    found = jaxsid.refine(model, part, fixed=["*.mass", "*.damping"], validate=False)
    check(found, {FRICTION: 3.0, "c1.stiffness": 900.0, "c2.stiffness": 700.0})


@pytest.mark.slow
def test_windows_records_and_absent_sensors(rubbing):
    """Two records, one with one sensor, in windows; what is fixed or tied keeps its value or ratio."""
    half = [
        jaxsid.Record(rubbing.u[a:b], rubbing.y[a:b, c], DT, inputs=("drive",), outputs=names)
        for a, b, c, names in ((0, 1200, [0, 1], ("s0", "s1")), (1200, 2400, [1], ("s1",)))
    ]
    model = chain([between("coulomb_friction", ("ground", "b1"), force=2.0)], wrong=0.0)
    found = jaxsid.refine(model, half, window=0.5, fixed=["*.mass"], tied=[["c1.damping", "c2.damping"]])
    check(found, {FRICTION: 3.0, "c1.stiffness": 900.0, "c2.stiffness": 700.0})
    assert float(found.value("b1.mass")) == 1.0
    ratio = float(found.value("c1.damping")) / float(found.value("c2.damping"))
    assert ratio == pytest.approx(1.5)


@pytest.mark.slow
def test_from_rest_without_effects(rubbing):
    """A linear model is fitted in time on request; what it lacks shows in what is left."""
    model = chain([], wrong=0.1)
    found = jaxsid.refine(model, rubbing, initial="rest", validate=False)
    assert found.validation is None
    assert (np.asarray(found.after) > 0.05).all()
    assert (np.asarray(found.after) < np.asarray(found.before)).all()
    assert found.residuals is not None
    off = np.abs(np.asarray(found.residuals.autocorrelation)[1:]) > found.residuals.white_limit
    assert off.mean() > 0.2


def test_what_cannot_be_refined_is_said(rubbing):
    model = chain([between("coulomb_friction", ("ground", "b1"), force=2.0)])
    with pytest.raises(InputError, match="impulse or frequency response cannot tell"):
        jaxsid.refine(model, jaxsid.ImpulseResponse(jnp.zeros((10, 2, 1)), DT))
    with pytest.raises(InputError, match="initial 'guess' is unknown"):
        jaxsid.refine(model, rubbing, initial="guess")
    with pytest.raises(InputError, match="this one is in time"):
        jaxsid.refine(model, rubbing, band=(1.0, 10.0))
    with pytest.raises(InputError, match="window must not be negative"):
        jaxsid.refine(model, rubbing, window=-1.0)
    with pytest.raises(InputError, match="did you mean"):
        jaxsid.refine(model, rubbing, fixed=["coulomb_friction(ground, b1).forces"])
    banded = jaxsid.Record(rubbing.u, rubbing.y, DT, inputs=("drive",), outputs=("s0", "s1"), hold="band")
    with pytest.raises(InputError, match="give the inputs a hold"):
        jaxsid.refine(model, banded)


DATA = (
    Path(os.environ.get("JAXSID_DATA", Path(__file__).parents[2] / "shared" / "data"))
    / "emps"
    / "DATA_EMPS.mat"
)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the EMPS record is not here; set JAXSID_DATA")
def test_emps_matches_the_published_parameters():
    """Linear axis with viscous friction, dry friction and offset (A. Janot, M. Gautier and M. Brunot, 2019)."""
    from scipy.io import loadmat

    data = loadmat(DATA)
    record = jaxsid.Record(
        (data["gtau"] * data["vir"]).ravel(),
        data["qm"],
        float(np.diff(data["t"].ravel()).mean()),
        inputs=("force",),
        outputs=("position",),
    )
    model = lumped_model(
        ["axis"],
        [130.0],
        [0.0],
        [140.0],
        connections=[Connection("guide", ("ground", "axis"))],
        inputs=[Input("force", "axis")],
        sensors=[Sensor("position", "axis", "displacement")],
        effects=[
            between("coulomb_friction", ("ground", "axis"), force=10.0),
            Effect("constant_load", (("body", "axis"),), {"force": jnp.asarray(1.0)}),
        ],
    )
    found = jaxsid.refine(model, record)
    published = {
        "axis.mass": (95.11, 0.01),
        "guide.damping": (203.5, 0.01),
        "coulomb_friction(ground, axis).force": (20.39, 0.01),
        "constant_load(axis).force": (3.165, 0.05),  # its offset is what the drive has to give
    }
    for name, (value, within) in published.items():
        assert float(found.value(name)) == pytest.approx(value, rel=within), name
        # what differs from stretch to stretch of the record is more than the residual's size tells
        assert abs(float(found.value(name)) - value) < 3 * float(found.deviation(name)), name
    assert found.validation is not None
    assert found.validation.better
