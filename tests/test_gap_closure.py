"""Free runs over pieces against whole simulations, the closure against its closed form, its interval, windows."""

import jax.numpy as jnp
import numpy as np
import pytest
from gap_bench import bench, colored, known
from gap_helpers import DT, SAMPLES, chain, drive, exact, record
from scipy.stats import norm

import jaxsid
from jaxsid.gap import closure as module
from jaxsid.gap.causes import noise_floor
from jaxsid.gap.closure import (
    SPREAD,
    Left,
    _run_on,
    closure_of,
    fraction,
    left_before,
    left_of,
    spread_of,
)
from jaxsid.gap.free_run import LEAD, PIECE, free_run
from jaxsid.gap.hypothesis import FIXED, parameter_rows
from jaxsid.gap.noise import REFUTED, Noise
from jaxsid.gap.refit import FINEST, UNRESOLVED, Hypothesis, refitted, shot_of
from jaxsid.gap.windows import blocks_of, untold
from jaxsid.mechanics.effects.catalogue import CATALOGUE
from jaxsid.mechanics.lumped import Effect

LONG = 2 * PIECE + 700


def effect(kind, place, **parameters):
    return Effect(kind, ((CATALOGUE[kind].where, place),), parameters)


@pytest.fixture(scope="module")
def of():
    return bench(*colored(exact(drive()), 0))


def run(of, effects, u, *, first=0, state=None, changes=0.0, substeps=2):
    shot = shot_of(of, effects)
    z = shot.coordinates.unknowns(parameter_rows(effects))
    theta = np.concatenate([np.full(9, changes), z.ravel()])
    state = np.zeros(6 + 2 * shot.slots.count) if state is None else state
    ramps = jnp.zeros(1, bool)
    given = {"record": 0, "first": first, "substeps": substeps}
    return free_run(shot, theta, u[:, None], ramps, DT, state, **given).outputs


def test_a_linear_run_is_exact(of):
    start = np.array([0.02, 0.0, -0.03, 0.3, 0.0, 0.1])
    u = drive(LONG)
    y = run(of, (), u, state=np.pad(start, (0, 2)))
    assert y.shape == (LONG, 3)
    truth = exact(u, start=start)
    np.testing.assert_allclose(y, truth, atol=1e-9 * truth.std())


def test_a_run_may_begin_anywhere(of):
    u, before = drive(LONG), 40
    early = run(of, (), u, first=-before)  # at rest before the record, where inputs are zero
    np.testing.assert_allclose(early[before:], exact(u), atol=1e-9 * exact(u).std())
    assert not early[:before].any()
    begin = PIECE + 100
    q, v = (exact(u, [(b, kind) for b in range(3)]) for kind in ("displacement", "velocity"))
    late = run(of, (), u, first=begin, state=np.concatenate([q[begin], v[begin], np.zeros(2)]))
    np.testing.assert_allclose(late, exact(u)[begin:], atol=1e-9 * exact(u).std())


MANY = [
    (effect("cubic_stiffness", ("b1", "b2"), coefficient=1e6), 1e-9),
    (effect("input_delay", "drive", delay=0.034), 1e-9),
    (effect("sensor_delay", "s1", delay=0.034), 1e-9),
    (effect("sensor_delay", "s1", delay=(LEAD - 20) * DT), 1e-9),
    (effect("time_varying_stiffness", ("b1", "b2"), rate=5.0), 1e-9),
    (effect("coulomb_friction", ("ground", "b1"), force=2.0), 1e-6),
]


@pytest.mark.parametrize(
    ("x", "tolerance"), [MANY[0], *(pytest.param(*m, marks=pytest.mark.slow) for m in MANY[1:])]
)
def test_pieces_are_the_whole_simulation(of, x, tolerance):
    u = drive(LONG)
    y = run(of, (x,), u, substeps=2)
    data = record(u, np.zeros((LONG, 3)))
    truth = np.asarray(jaxsid.simulate(chain(effects=[x]), data, substeps=2))
    np.testing.assert_allclose(y, truth, atol=tolerance * truth.std())
    plain = exact(u)
    assert np.sqrt(((truth - plain)[PIECE:] ** 2).mean()) > 1e-3 * plain.std()  # the effect is to be seen


def test_the_fraction():
    assert fraction(0.5, 0.3, 0.0) == pytest.approx(0.4)
    assert fraction(0.5, 0.3, 0.3) == 1.0
    assert fraction(np.hypot(0.5, 0.2), np.hypot(0.1, 0.2), 0.2) == pytest.approx(0.8)
    assert fraction(0.5, 0.5, 0.1) == 0.0
    assert fraction(0.5, 0.6, 0.1) == 0.0  # it did not shrink
    assert fraction(0.5, 0.09, 0.1) == 1.0  # less than noise is noise
    assert fraction(0.1, 0.05, 0.1) == 0.0  # no gap to shrink
    assert fraction(0.1, 0.05, 0.2) == 0.0


def drawn(seed, sizes, samples=1600):
    """What three models leave of two sensors, white, the second absent from one of two records."""
    rng = np.random.default_rng(seed)
    scale = np.array([1.0, 5.0])
    white = lambda size: tuple(size * scale * rng.standard_normal((samples, 2)) for _ in range(2))  # noqa: E731
    measured = white(1.0)
    hidden = np.where([[True, False]], 0.0, np.nan)
    masked = lambda x: (x[0], x[1] + hidden)  # noqa: E731
    return [Left(masked(white(size)), masked(measured)) for size in sizes], scale


def test_the_closure_is_that_of_what_is_left():
    sizes, noise = (0.5, 0.3, 0.14), 0.1
    (nominal, linear, after), scale = drawn(0, sizes)
    noises = [
        known(noise * scale * np.sqrt(1 - 0.25))
    ] * 2  # coloured: its deviation is that of white / sqrt(1 - a^2)
    found = closure_of(nominal, linear, after, noises, ["a", "b"])
    np.testing.assert_allclose([found.before, found.recalibrated, found.after], sizes, rtol=0.04)
    assert found.noise_floor == pytest.approx(noise, rel=0.03)
    assert found.fraction == fraction(found.before, found.after, found.noise_floor)
    assert found.against_recalibrated == fraction(found.recalibrated, found.after, found.noise_floor)
    assert found.fraction == pytest.approx(0.8, abs=0.02)
    by_hand = (
        np.concatenate([x[:, 0] for x in after.left]).std()
        / np.concatenate([x[:, 0] - x[:, 0].mean() for x in after.measured]).std()
    )
    assert found.by_sensor["a"] == pytest.approx(by_hand, rel=1e-3)
    assert set(found.by_sensor) == {"a", "b"}
    assert found.noise_by_sensor["a"] == pytest.approx(noise, rel=0.05)
    pooled = np.sqrt(np.mean(np.square(list(found.noise_by_sensor.values()))))
    assert pooled == pytest.approx(found.noise_floor)
    assert set(found.as_dict()) == {
        "heldout_before",
        "heldout_recalibrated",
        "heldout_after",
        "noise_floor",
        "fraction",
        "ci95",
        "against_recalibrated",
        "by_sensor",
        "noise_by_sensor",
    }


def test_the_interval_covers(monkeypatch):
    monkeypatch.setattr(module, "DRAWS", 300)
    sizes, noise = (0.5, 0.3, 0.2), 0.1
    truth = fraction(sizes[0], sizes[2], noise)
    inside, widths = 0, []
    for seed in range(40):
        lefts, scale = drawn(seed, sizes, 400)
        found = closure_of(*lefts, [known(noise * scale * np.sqrt(0.75))] * 2, ["a", "b"])
        inside += found.ci95[0] <= truth <= found.ci95[1]
        widths.append(found.ci95[1] - found.ci95[0])
    assert inside >= 34
    assert np.mean(widths) < 0.1


@pytest.mark.parametrize("windowed", [False, True])
def test_a_right_model_leaves_noise_of_what_it_has_not_seen(of, windowed):
    """Its run goes on from the last window that was fitted, or begins anew in every window."""
    u = drive(4 * SAMPLES)
    y, level = colored(exact(u), 0)
    frozen = of._replace(tolerance=np.full(9, FIXED))
    data = record(u, y[:, :2], kinds=((0, ""), (1, "")))
    noise = known(np.append(level[:2], np.nan))
    found = left_of(refitted(frozen, Hypothesis()), frozen, [data], [3 * SAMPLES], windowed=windowed)
    (left,), (measured,), windows = found
    length = of.blocks[0].y.shape[1] - of.blocks[0].lead
    assert windows == ((pytest.approx(length * DT),) if windowed else ())
    assert left.shape == measured.shape == (SAMPLES, 3)
    assert np.isnan(left[:, 2]).all()
    np.testing.assert_array_equal(measured[:, :2], y[-SAMPLES:, :2])
    rms = np.sqrt((left[:, :2] ** 2).mean(axis=0)) / noise.rms()[:2]
    np.testing.assert_allclose(rms, 1, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("windowed", [False, True])
def test_steps_are_short_enough_for_a_motion_that_was_not_seen(monkeypatch, windowed):
    """A loop whose memory is slow where the motion is small follows a large one at once."""
    loop = effect("hysteresis", ("ground", "b1"), stiffness=300.0, beta=2e4, gamma=0.0, exponent=1.0)
    u = drive(2 * SAMPLES) * np.repeat([0.02, 0.4], SAMPLES)
    y, level = colored(exact(u), 0)
    quiet = bench(y[:SAMPLES], level, u=u[:SAMPLES])
    frozen = quiet._replace(tolerance=np.full(9, FIXED), substeps=2)
    found = refitted(frozen, Hypothesis((loop,)), steps=0)

    def left(substeps):
        at = frozen._replace(substeps=substeps)
        return left_of(found, at, [record(u, y)], [SAMPLES], windowed=windowed).left[0]

    rms = lambda x: np.sqrt(np.nanmean(x**2, axis=0))  # noqa: E731
    finest, own = left(FINEST), left(2)
    assert (rms(own - finest) < UNRESOLVED * rms(finest)).all()
    monkeypatch.setattr(module, "FINEST", 2)
    assert not (rms(left(2) - finest) < UNRESOLVED * rms(finest)).any()


def test_what_is_left_before_is_noise_sample_by_sample():
    y, level = colored(exact(drive()), 0)
    absent = np.append(level[:2], np.nan)
    data = record(drive(), y[:, :2], kinds=((0, ""), (1, "")))
    cut = bench(y, level)
    blocks = blocks_of(chain(), [data], [known(absent)], cut.blocks[0].y.shape[1] - cut.blocks[0].lead)
    cut = cut._replace(blocks=blocks, states=tuple(np.zeros((len(b.y), 6)) for b in blocks))
    (left,) = left_before(refitted(cut, Hypothesis()), cut).left
    first = untold(SAMPLES)
    assert np.isfinite(left[first:SAMPLES, :2]).all()
    assert np.isnan(left[:first]).all()
    assert np.isnan(left[SAMPLES:]).all()
    assert np.isnan(left[:, 2]).all()
    # modelled less measured; the states of windows take up a part of the noise
    noise = (y - exact(drive()))[:, :2]
    assert ((left[:SAMPLES, :2] + noise)[first:].std(axis=0) < 0.4 * noise.std(axis=0)).all()


@pytest.mark.parametrize("few", [3, 60])
def test_a_run_begins_at_a_window_with_many_samples(of, few):
    length = of.blocks[0].y.shape[1] - of.blocks[0].lead
    u = drive(2 * length + few * length // 100)
    y, level = colored(exact(u), 0)
    cut = bench(y, level, u=u)
    frozen = cut._replace(tolerance=np.full(9, FIXED))
    _, start = _run_on(refitted(frozen, Hypothesis()), frozen, record(u, y), 0)
    assert start == (2 if few > 50 else 1) * length - cut.blocks[0].lead


def test_windows_begin_anew():
    """With springs 5 % off a run through all of the held-out samples leaves more than windows do."""
    u = drive(4 * SAMPLES)
    y, level = colored(exact(u), 0)
    wrong = bench(y[:SAMPLES], level, u=u[:SAMPLES], model=chain(factor=1.05))
    frozen = wrong._replace(tolerance=np.full(9, FIXED))
    found = refitted(frozen, Hypothesis())
    given = found, frozen, [record(u, y)], [3 * SAMPLES]
    free, windows = (np.sqrt((left_of(*given, windowed=x).left[0] ** 2).mean(axis=0)) for x in (False, True))
    assert (windows < 0.98 * free).all()
    assert (windows > 2 * known(level).rms()).all()


def test_runs_part_as_far_as_what_is_not_known_of_the_numbers_makes_them():
    """The error of runs over unseen samples, next to what noise-free ones would be, is what the deviations say."""
    u = drive(4 * SAMPLES)
    truth = exact(u)
    ratios = []
    for seed in range(8):
        y, level = colored(truth, seed)
        fit_to = bench(y[: 3 * SAMPLES], level, u=u[: 3 * SAMPLES])
        found = refitted(fit_to, Hypothesis())
        data = record(u, y)
        left = left_of(found, fit_to, [data], [3 * SAMPLES], windowed=False)
        spread = spread_of(found, fit_to, [data], left)
        assert spread.measured is left.measured
        error = left.left[0] + y[3 * SAMPLES :] - truth[3 * SAMPLES :]
        ratios.append((error**2).mean(axis=0) / (spread.left[0] ** 2).mean(axis=0))
    assert 0.4 < np.mean(ratios) < 2.5


def test_what_is_not_known_of_one_number_parts_runs_along_its_slope(of):
    u = drive(2 * SAMPLES)
    y, _ = colored(exact(u), 0)
    hidden = np.where([True, True, False], 0.0, np.nan)
    found, step, which = refitted(of, Hypothesis()), 1e-4, 4
    given = of, [record(u, y + hidden)], [SAMPLES]

    def left(change):
        theta = found.fit.theta + change * np.eye(len(found.fit.theta))[which]
        return left_of(found._replace(fit=found.fit._replace(theta=theta)), *given, windowed=False)

    slope = (left(step).left[0] - left(-step).left[0]) / (2 * step)
    alone = np.zeros_like(found.fit.covariance)
    alone[which, which] = step**2
    of_one = found._replace(fit=found.fit._replace(covariance=alone))
    spread = spread_of(of_one, of, given[1], left(0.0)).left[0]
    drawn = np.random.default_rng(0).standard_normal((SPREAD, len(alone)))[:, -1]
    size = np.median(np.abs(drawn)) / norm.ppf(0.75)
    np.testing.assert_allclose(
        spread, size * step * np.abs(slope), rtol=0.02, atol=0.01 * step * np.nanstd(slope)
    )
    np.testing.assert_array_equal(np.isnan(spread), [[False, False, True]] * SAMPLES)
    # a damper known so little that it may push makes some runs grow without bound, of which no number comes
    far, wild = 1e4, np.zeros_like(alone)
    wild[which, which] = far**2
    assert not np.isfinite(left(-far).left[0][:, :2]).all()
    widely = found._replace(fit=found.fit._replace(covariance=wild))
    assert np.isfinite(spread_of(widely, of, given[1], left(0.0)).left[0][:, :2]).all()
    # and counts in the closure as all else does
    lefts = left(0.0), left(0.0), left(0.0)
    closed = closure_of(*lefts, [known(np.array([0.1, 0.1, np.nan]))], ["a", "b", "c"], spread=lefts[2])
    assert closed.unsure == pytest.approx(closed.after)
    assert "unsure" not in closed.as_dict()


def test_noise_of_other_samples_is_no_louder_than_what_any_model_leaves_of_them():
    """A law under which the motion grows without bound, and noise that was guessed from windows that forgive it."""
    guess, told = (
        Noise(np.array([0.35]), np.array([[1.0]]), degrees, "residual") for degrees in (0.0, 500.0)
    )

    def floor(*rms, of=guess, part=REFUTED):
        own, *others = (Left((np.full((400, 1), x),), ()) for x in rms)
        (found,) = noise_floor((of,), own, others, part)
        return found

    assert floor(31.0, 0.088, 0.02).rms() == pytest.approx(0.02)
    # a sensor may by chance leave a little less than another model's noise
    assert floor(0.34, 0.33, 0.30).rms() == pytest.approx(0.34)
    assert floor(31.0, 0.34, 0.02, of=told).rms() == pytest.approx(0.02)
    assert floor(31.0, 0.34, 0.02, of=told, part=0.0).rms() == pytest.approx(0.35)
