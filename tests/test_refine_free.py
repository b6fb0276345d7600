"""Refinement of free symmetric matrices, from many starts, and profile likelihoods."""

import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import THREE
from chains import ONE, chain_model, exact_response, factors, truth_of
from scipy.linalg import expm
from scipy.optimize import brentq, least_squares

from jaxsid import ImpulseResponse, InputError, Matrices, lumped_model, refine, second_order
from jaxsid.impulse.spectra import FrequencyResponse
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.uncertainty.noise import IndependentNoise

TWO = ([1.2, 0.8], [3000.0, 2000.0], [1.5, 0.8])
DT = 0.002


def triple(model):
    linear = second_order(model)
    return [np.asarray(x) for x in (linear.mass, linear.damping, linear.stiffness)]


def in_matrices(model, **changed):
    linear = second_order(model)
    given = {"mass": linear.mass, "damping": linear.damping, "stiffness": linear.stiffness} | changed
    return lumped_model(
        model.bodies,
        matrices=Matrices(given["mass"], given["damping"], given["stiffness"]),
        inputs=model.inputs,
        sensors=model.sensors,
    )


def noisy(model, level, seed, samples=200):
    h = np.asarray(exact_response(model, samples).h)
    size = level * h.std(axis=(0, 2))
    e = np.random.default_rng(seed).standard_normal(h.shape) * size[:, None]
    return ImpulseResponse(jnp.asarray(h + e), DT), IndependentNoise(jnp.asarray(size**2)), size


def response(M, D, K, samples):
    """Accelerations of all bodies after a held unit force on the first, by scipy."""
    n = len(M)
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    B = np.concatenate([np.zeros(n), inverse[:, 0]])
    whole = expm(DT * np.block([[A, B[:, None]], [np.zeros((1, 2 * n + 1))]]))
    # states after 1, 2, 4 ... samples give as many further ones at once
    states, step = whole[: 2 * n, 2 * n :], whole[: 2 * n, : 2 * n]
    while states.shape[1] < samples - 1:
        states, step = np.concatenate([states, step @ states], axis=1), step @ step
    read = np.concatenate([-inverse @ K, -inverse @ D], axis=1)
    return np.concatenate([inverse[:, :1], read @ states[:, : samples - 1]], axis=1).T


@pytest.mark.parametrize(
    "elements", [pytest.param(ONE, marks=pytest.mark.slow, id="one"), pytest.param(THREE, id="three")]
)
def test_every_entry_is_found_exactly_from_far_away(elements):
    truth, rng = chain_model(elements), np.random.default_rng(0)
    found = refine(chain_model(elements, factors(rng, elements)), exact_response(truth), structure="free")
    for x, y in zip(triple(found.model), triple(truth), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-8 * np.abs(y).max())
    n = len(elements[0])
    assert len(found.elements.listed) == 3 * n * (n + 1) // 2
    assert found.warnings == ()


def test_matrices_keep_the_zeros_that_they_are_given():
    truth = chain_model(THREE)
    wrong = in_matrices(chain_model(THREE, factors(np.random.default_rng(1), THREE)))
    ir, noise, _ = noisy(truth, 0.02, 1, 400)
    found = refine(wrong, ir, noise=noise, validate=False)
    for x, y in zip(triple(found.model), triple(truth), strict=True):
        assert (x[y == 0] == 0).all()
        np.testing.assert_allclose(x, y, atol=0.15 * np.abs(y).max())
    # the chain's elements have as many unknowns, and are all positive here: the same fit by other numbers
    elements = refine(chain_model(THREE), ir, noise=noise, validate=False)
    assert float(found.misfit) == pytest.approx(float(elements.misfit), rel=1e-9)
    for x, y in zip(triple(found.model), triple(elements.model), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5 * np.abs(y).max())


def left_by(lower, h, size):
    """Weighted residual of M, D, K given as triangular factors."""
    parts = []
    for x in np.split(lower, 3):
        factor = np.zeros((2, 2))
        factor[np.tril_indices(2)] = x
        parts.append(factor @ factor.T)
    return ((response(*parts, len(h)) - h) / size).ravel()


def roots(matrices):
    return np.concatenate([
        np.linalg.cholesky(x + 1e-9 * np.abs(x).max() * np.eye(2))[np.tril_indices(2)] for x in matrices
    ])  # fmt: skip


@pytest.mark.slow
def test_damping_on_the_edge_is_the_best_positive_one():
    """Noise asks for negative damping somewhere: the answer is on the edge, and no positive matrices fit better."""
    truth = chain_model(([1.2, 0.8], [3000.0, 2000.0], [1.5, 0.0]))
    ir, noise, size = noisy(truth, 0.1, 2)
    found = refine(chain_model(TWO), ir, noise=noise, structure="free", validate=False)
    mass, damping, stiffness = triple(found.model)
    assert np.linalg.eigvalsh(mass)[0] > 0
    assert np.linalg.eigvalsh(stiffness)[0] > 0
    assert 0 <= np.linalg.eigvalsh(damping)[0] < 1e-5
    assert any("damping (positive only just)" in x for x in found.warnings)
    h = np.asarray(ir.h)[:, :, 0]
    own = 0.5 * (((response(mass, damping, stiffness, len(h)) - h) / size) ** 2).sum()
    starts = roots((mass, damping + 0.1 * np.eye(2), stiffness)), roots(triple(truth))
    least = min(
        least_squares(
            lambda x: left_by(x, h, size), s, x_scale=np.where(s == 0, 1.0, np.abs(s)), xtol=1e-14
        ).cost
        for s in starts
    )
    assert own < least + 1e-3


@pytest.mark.slow
def test_profile_on_the_edge_keeps_matrices_positive():
    """The others, too, are refitted among positive matrices: none that is not makes the rise smaller."""
    truth = chain_model(([1.2, 0.8], [3000.0, 2000.0], [1.5, 0.0]))
    ir, noise, size = noisy(truth, 0.1, 2)
    found = refine(
        chain_model(TWO), ir, noise=noise, structure="free", validate=False, profile=["b1, b2.damping"]
    )
    assert not any("lesser optimum" in x for x in found.warnings)
    (profile,) = found.profiles
    assert float(profile.rise.min()) > -1e-3
    h, at = np.asarray(ir.h)[:, :, 0], int(np.argmin(np.abs(np.asarray(profile.rise) - 3.84)))
    value = -float(profile.values[at])  # a damper between bodies is the entry with the sign changed

    def held(lower):
        # D = [[a^2, v], [v, (v / a)^2 + b^2]]: its off-diagonal entry given, and positive by construction
        a, b = lower[3:5]
        d = np.array([[a * a, value], [value, (value / a) ** 2 + b * b]])
        factors = [np.zeros((2, 2)), np.zeros((2, 2))]
        for factor, x in zip(factors, (lower[:3], lower[5:]), strict=True):
            factor[np.tril_indices(2)] = x
        m, k = (x @ x.T for x in factors)
        return ((response(m, d, k, len(h)) - h) / size).ravel()

    mass, damping, stiffness = triple(found.model)
    start = np.concatenate([roots((mass,)), np.sqrt(np.diag(damping)), roots((stiffness,))])
    starts = [start * np.exp(0.3 * np.random.default_rng(i).standard_normal(8)) for i in range(12)]
    least = min(
        least_squares(held, x, x_scale=np.abs(start) + 1e-3, xtol=1e-14).cost for x in (start, *starts)
    )
    own = ((response(mass, damping, stiffness, len(h)) - h) / size).ravel()
    rise = (2 * least - own @ own) / max(float(found.misfit), 1.0)
    assert float(profile.rise[at]) == pytest.approx(rise, rel=1e-2, abs=1e-2)


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 10, 17, 19])
def test_damping_on_the_edge_does_not_lead_away_from_the_best(seed):
    """Where the best free matrices are not positive the fit still explains the data better than the truth does."""
    truth = chain_model(THREE)
    ir, noise, size = noisy(truth, 0.3, seed)
    start = chain_model(THREE, factors(np.random.default_rng(100 + seed), THREE))
    found = refine(start, ir, noise=noise, structure="free", validate=False)
    assert any("damping (positive only just)" in x for x in found.warnings)
    assert bool(found.converged)
    h = np.asarray(ir.h)[:, :, 0]
    own, true = ((((response(*triple(m), len(h)) - h) / size) ** 2).sum() for m in (found.model, truth))
    assert own < true


@pytest.mark.slow
def test_what_is_known_holds_for_free_matrices_too():
    truth = chain_model(([1.2, 0.8], [3000.0, 2000.0], [1.5, 0.0]))
    ir, noise, _ = noisy(truth, 0.1, 2)
    known = {"fixed": ["b1.mass", "b1, b2.mass"], "bounds": {"b2.mass": (0.5, 0.79)}}
    found = refine(chain_model(TWO), ir, noise=noise, structure="free", validate=False, **known)
    mass, damping, _ = triple(found.model)
    assert mass[0, 0] == 1.2
    assert mass[0, 1] == 0.0
    assert mass[1, 1] == pytest.approx(0.79, rel=1e-6)
    assert np.linalg.eigvalsh(damping)[0] >= 0
    assert "b2.mass" in found.at_bound


def test_fixed_values_that_leave_nothing_positive_are_told():
    model = in_matrices(chain_model(TWO), damping=jnp.array([[-1.0, 0.2], [0.2, 1.0]]))
    ir = exact_response(chain_model(TWO))
    with pytest.raises(InputError, match="leave no positive damping"):
        refine(model, ir, fixed=["*.damping"])
    with pytest.raises(InputError, match="structure 'banded' is unknown"):
        refine(model, ir, structure="banded")


def test_profile_is_the_misfit_of_the_others_fitted_anew():
    truth = chain_model(ONE)
    ir, noise, size = noisy(truth, 0.4, 3)
    h, names = np.asarray(ir.h)[:, :, 0], ["b1.mass", "c1.damping", "c1.stiffness"]
    found = refine(truth, ir, noise=noise, validate=False, profile=names[1:])

    def left(x):
        return ((response(*(np.array([[v]]) for v in x), len(h)) - h) / size).ravel()

    best = least_squares(left, [1.2, 1.5, 3000.0], x_scale=[1.0, 1.0, 3000.0], xtol=1e-15, ftol=1e-15)
    scale = max(float(found.misfit), 1.0)

    def rise(i, value):
        rest = [j for j in range(3) if j != i]
        full = lambda part: np.insert(part, i, value)  # noqa: E731
        fit = least_squares(
            lambda part: left(full(part)),
            best.x[rest],
            x_scale=np.array([1.0, 1.0, 3000.0])[rest],
            xtol=1e-15,
            ftol=1e-15,
        )
        return 2 * (fit.cost - best.cost) / scale

    for profile, i in zip(found.profiles, (1, 2), strict=True):
        assert profile.name == names[i]
        for k in (0, 3, 12, -1):
            assert float(profile.rise[k]) == pytest.approx(
                rise(i, float(profile.values[k])), rel=1e-3, abs=1e-4
            )
        low, high = np.asarray(profile.interval)
        wide = 3 * float(found.deviation(names[i]))
        ends = [
            brentq(lambda v, i=i: rise(i, v) - 3.8415, *sorted((best.x[i], best.x[i] + side * wide)))
            for side in (-1, 1)
        ]
        np.testing.assert_allclose([low, high], ends, rtol=1e-3)
        assert low < best.x[i] < high


@pytest.mark.slow
def test_profile_ends_at_a_bound_and_needs_an_unknown():
    truth = chain_model(TWO, sensed=(0,))
    ir, noise, _ = noisy(truth, 0.3, 4)
    found = refine(
        truth, ir, noise=noise, validate=False, profile=["c2.damping"], bounds={"c2.damping": (0.79, 5.0)}
    )
    assert float(found.profiles[0].interval[0]) == pytest.approx(0.79)
    with pytest.raises(InputError, match=r"profile: 'b1.mass' is fixed"):
        refine(truth, ir, fixed=["b1.mass"], profile=["b1.mass"])
    with pytest.raises(InputError, match="stands for several"):
        refine(truth, ir, profile=["*.mass"])


@pytest.mark.slow
def test_starts_find_what_the_nominal_model_leads_away_from():
    """Frequency responses around sharp resonances alone, where a fit from beside them sees no way to them."""

    def of(model, f):
        plain = physical_displacement_velocity(second_order(model))
        A, B, C, D = (np.asarray(x) for x in (plain.A, plain.B, plain.C, plain.D))
        inner = np.linalg.solve(2j * np.pi * f[:, None, None] * np.eye(len(A)) - A, B[None].astype(complex))
        return C @ inner + D

    light = (THREE[0], THREE[1], [0.05, 0.05, 0.05])
    f = np.concatenate([centre * np.linspace(0.97, 1.03, 40) for centre in (4.06, 9.85, 14.2)])
    H, ones = of(chain_model(light), f), jnp.ones((len(f), 3))
    seen = FrequencyResponse(jnp.asarray(f), jnp.asarray(H), jnp.ones(H.shape), ones, 1e-12 * ones, 10)
    wrong, truth = chain_model(light, factors(np.random.default_rng(1), light)), truth_of(light)
    alone = refine(wrong, seen, validate=False)
    many = refine(wrong, seen, validate=False, starts=100, seed=1)
    assert np.abs(np.asarray(alone.elements.values) / truth - 1).max() > 0.1
    assert any("times the noise" in x or "ran away" in x for x in alone.warnings)
    np.testing.assert_allclose(many.elements.values, truth, rtol=1e-8)
    with pytest.raises(InputError, match="starts must not be negative"):
        refine(wrong, seen, starts=-1)
