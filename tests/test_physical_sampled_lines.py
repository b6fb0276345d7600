"""What sampling adds to lines, against scipy's sampled systems at frequencies near that of Nyquist."""

import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import chain, state_space
from scipy import signal

import jaxsid
from jaxsid.impulse.lines import record_lines
from jaxsid.mechanics.lumped import Connection, Input, Sensor
from jaxsid.physical.inband_fit import fit_target, line_model, line_residual, upper_triangles
from jaxsid.physical.sampled_lines import with_sampling
from jaxsid.records import ContinuousModel, Realization, Record, SecondOrderModel

DT = 1 / 60  # modes at 4 and 12 Hz, the band up to 27 Hz of 30
SYSTEM = chain([1.2, 0.9], [3000, 2500], [1.5, 1.2])
LOOSE = chain([1.2, 0.9], [0, 2500], [0, 1.2])


def sensed(system):
    none = jnp.zeros((2, 2))
    return SecondOrderModel(
        *(jnp.asarray(x) for x in system[:3]), jnp.asarray(system.force), none, none, jnp.eye(2), None
    )


def goal(hold="zero", system=SYSTEM):
    u = np.random.default_rng(0).standard_normal((600, 1))
    A, B, C, D, _ = signal.cont2discrete(state_space(system), DT)
    x, y = np.zeros(4), []
    for push in u:
        y.append(C @ x + D @ push)
        x = A @ x + B @ push
    lines = record_lines([Record(u, np.array(y), DT, hold=(hold,))], band=(1.0, 27.0))
    plain = ContinuousModel(*(jnp.asarray(x) for x in state_space(system)))
    return lines, fit_target(lines, jnp.ones(lines.y.shape), Realization(A, B, C, D, DT), plain)


def sampled_lines(lines, matrices, hold):
    """Of the sampled system, by scipy."""
    M, damping, K = matrices
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ damping]])
    B = np.concatenate([np.zeros((2, 1)), inverse @ SYSTEM.force])
    wide = {"zero": "zoh", "first": "foh"}[hold]
    A, B, C, D, _ = signal.cont2discrete((A, B, A[2:], B[2:]), DT, method=wide)
    z = np.asarray(lines.z)[:, None, None]
    return np.einsum("koi,ki->ko", C @ np.linalg.solve(z * np.eye(4) - A, B[None]) + D, np.asarray(lines.u))


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("system", [SYSTEM, LOOSE], ids=["held", "loose"])
def test_lines_and_slopes_are_those_of_the_sampled_system(hold, system):
    lines, target = goal(hold, system)
    matrices = tuple(np.asarray(x) for x in system[:3])
    given = tuple(jnp.asarray(x) for x in matrices)
    found = with_sampling(target, lines, given, sensed(system), jnp.asarray(True))
    plain, slopes = line_model(found, given, sensed(system))
    np.testing.assert_allclose(
        plain + lines.y - found.y, sampled_lines(lines, matrices, hold), rtol=1e-8, atol=1e-9
    )
    i, j = np.triu_indices(2)
    for entry in range(9):
        step = 1e-5 * max(np.abs(matrices[entry // 3]).max(), 1.0)
        moved = [x.copy() for x in matrices]
        ends = []
        for sign in (1, -1):
            moved[entry // 3] = matrices[entry // 3].copy()
            moved[entry // 3][i[entry % 3], j[entry % 3]] += sign * step
            moved[entry // 3][j[entry % 3], i[entry % 3]] = moved[entry // 3][i[entry % 3], j[entry % 3]]
            ends.append(sampled_lines(lines, moved, hold))
        wanted = (ends[0] - ends[1]) / (2 * step)
        both = slopes[:, entry] + found.sampling.slopes[:, entry]
        np.testing.assert_allclose(both, wanted, rtol=1e-5, atol=1e-5 * np.abs(wanted).max())


def test_residuals_follow_the_sampled_system_to_first_order():
    lines, target = goal()
    about = tuple(jnp.asarray(x) for x in SYSTEM[:3])
    bent = with_sampling(target, lines, about, sensed(SYSTEM), jnp.asarray(True))
    left = []
    for size in (1.0, 0.1):
        factors = 1 + size * np.array([0.001, -0.02, -0.001])
        near = tuple(x * f for x, f in zip(about, factors, strict=True))
        r, j = line_residual(bent, near, sensed(SYSTEM))
        # back to where the lines come from, by the residual's own slopes
        back = upper_triangles(about) - upper_triangles(near)
        left.append(float(jnp.linalg.norm(r + j @ back) / jnp.linalg.norm(r)))
    assert left[0] < 0.1
    assert left[1] < 0.12 * left[0]


def test_a_target_that_is_not_fitted_to_stays_as_it_is():
    lines, target = goal()
    given = tuple(jnp.asarray(x) for x in SYSTEM[:3])
    found = with_sampling(target, lines, given, sensed(SYSTEM), jnp.asarray(False))
    for ours, before in zip(
        line_residual(found, given, sensed(SYSTEM)), line_residual(target, given, sensed(SYSTEM)), strict=True
    ):
        np.testing.assert_allclose(ours, before, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_near_the_frequency_of_nyquist_a_mass_is_as_certain_as_is_said():
    """Noise that falls with frequency makes the last lines tell most; of their phase half comes from aliases."""
    model = jaxsid.lumped_model(
        ["b1"],
        [1.2],
        [200.0],
        [8.0],
        connections=[Connection("c1", ("ground", "b1"))],
        inputs=[Input("f", "b1")],
        sensors=[Sensor("s1", "b1", "acceleration")],
    )
    rng = np.random.default_rng(3)
    u = rng.standard_normal((2000, 1))
    A = np.array([[0.0, 1.0], [-200 / 1.2, -8 / 1.2]])
    plain = A, np.array([[0.0], [1 / 1.2]]), A[1:], np.array([[1 / 1.2]])
    y = np.asarray(signal.dlsim((*signal.cont2discrete(plain, DT)[:4], DT), u)[1])
    pulls = []
    for _ in range(200):
        e = signal.lfilter([1], np.poly([0.95, 0.9]), rng.standard_normal((2500, 1)), axis=0)[500:]
        record = Record(u, y + 0.05 * y.std() * e / e.std(), DT, inputs=("f",), outputs=("s1",))
        found = jaxsid.refine(model, record, band=(1.0, 28.0), validate=False)
        pulls.append((np.asarray(found.elements.values) - found.elements.nominal) / found.elements.deviation)
    # the standard error of each is 5 %
    sizes = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (np.abs(sizes - 1) < 0.2).all(), sizes
