"""Evidence of a force behind a transfer against the normal law written out, and its invariances."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from jaxsid.gap.evidence import Force, Table, density, evidence, factor_of, split, table

LINES, OUTPUTS, COLUMNS, STATES = 7, 2, 3, 2


def problem(seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.standard_normal(shape) + 1j * rng.standard_normal(shape)  # noqa: E731
    return {
        "columns": draw(LINES, OUTPUTS, COLUMNS + 1),
        "free": draw(LINES, OUTPUTS, STATES),
        "transfer": draw(LINES, OUTPUTS),
        "scale": rng.uniform(0.5, 2.0, (LINES, OUTPUTS)),
        "density": rng.uniform(0.1, 3.0, (4, LINES)),
        "transient": np.array([2.0, 0.7]),
    }


def given(problem):
    return table(*(jnp.asarray(problem[k]) for k in problem))


def dense(problem, prior, hypothesis):
    """Logarithm of the density of the lines, less that of the noise's own scale and of 2 pi."""
    real = lambda x: np.concatenate([x.real, x.imag])  # noqa: E731
    flat = lambda x: (x * problem["scale"][:, :, None]).reshape(LINES * OUTPUTS, -1)  # noqa: E731
    columns, free = flat(problem["columns"]), flat(problem["free"])
    g = problem["transfer"] * problem["scale"]
    cover = np.zeros((LINES * OUTPUTS,) * 2, complex)
    for i in range(LINES):
        rows = slice(i * OUTPUTS, (i + 1) * OUTPUTS)
        cover[rows, rows] = np.eye(OUTPUTS) + problem["density"][hypothesis, i] * np.outer(g[i], g[i].conj())
    # a circular line of covariance S: its parts have covariances Re S / 2 and Im S / 2
    law = np.block([[cover.real, -cover.imag], [cover.imag, cover.real]]) / 2
    for x, std in ((columns[:, :-1], prior), (free, problem["transient"])):
        moved = real(x) * std
        law = law + moved @ moved.T
    r = real(columns[:, -1])
    value = scipy.stats.multivariate_normal(np.zeros(len(r)), law).logpdf(r)
    return value + 0.5 * len(r) * np.log(2 * np.pi) + 0.5 * len(r) * np.log(0.5)


def test_evidence_is_that_of_the_normal_law():
    p, prior = problem(), np.array([0.5, 2.0, 0.0])
    found = evidence(given(p), prior[None])
    expected = [dense(p, prior, h) for h in range(4)]
    np.testing.assert_allclose(found.value[0], expected, rtol=1e-9)
    assert (found.coefficients[0, :, 2] == 0).all()


def test_coefficients_are_the_posterior_mean():
    p, prior = problem(1), np.array([0.5, 2.0, 1.0])
    found = evidence(given(p), prior[None])
    p["density"] = p["density"][:1] * 0
    plain = evidence(given(p), prior[None])
    real = lambda x: np.concatenate([x.real, x.imag])  # noqa: E731
    flat = lambda x: (x * p["scale"][:, :, None]).reshape(LINES * OUTPUTS, -1)  # noqa: E731
    rows = np.sqrt(2) * real(np.concatenate([flat(p["columns"][:, :, :-1]), flat(p["free"])], axis=1))
    std = np.concatenate([prior, p["transient"]])
    target = np.sqrt(2) * real(flat(p["columns"][:, :, -1:]))[:, 0]
    expected = np.linalg.solve(rows.T @ rows + np.diag(std**-2), rows.T @ target)[:3]
    np.testing.assert_allclose(plain.coefficients[0, 0], expected, rtol=1e-9)
    assert np.abs(found.coefficients - plain.coefficients).max() > 1e-3


def test_records_add_up():
    one, two, prior = problem(2), problem(3), np.array([0.5, 2.0, 1.0])
    both = jax.tree.map(lambda a, b: a + b, given(one), given(two))
    alone = Table(*(x * 2 for x in given(one)))
    assert np.isfinite(evidence(both, prior[None]).value).all()
    np.testing.assert_allclose(
        evidence(alone, prior[None]).value,
        evidence(jax.tree.map(lambda a: a + a, given(one)), prior[None]).value,
    )


def test_order_of_sensors_does_not_matter():
    p, prior = problem(4), np.array([0.5, 2.0, 1.0])
    turned = {**p, **{k: p[k][:, ::-1] for k in ("columns", "free", "transfer", "scale")}}
    np.testing.assert_allclose(
        evidence(given(p), prior[None]).value, evidence(given(turned), prior[None]).value, rtol=1e-10
    )


def test_split_is_orthogonal():
    p = problem(5)
    along, rest, square = split(jnp.asarray(p["columns"]), jnp.asarray(p["transfer"]))
    assert np.abs(np.einsum("lp,lpk->lk", p["transfer"].conj(), rest)).max() < 1e-12
    total = (np.abs(along) ** 2).sum() + (np.abs(rest) ** 2).sum()
    np.testing.assert_allclose(total, (np.abs(p["columns"]) ** 2).sum())
    np.testing.assert_allclose(square, (np.abs(p["transfer"]) ** 2).sum(axis=1))


def test_density_sums_to_the_variance():
    dt, samples = 0.001, 200_000
    omega = 2 * np.pi * np.arange(samples // 2 + 1) / (samples * dt)
    found = density(Force(jnp.array([3.0]), jnp.array([25.0])), jnp.asarray(omega), jnp.asarray(dt))
    np.testing.assert_allclose(2 * np.asarray(found).sum() / samples, 9.0, rtol=1e-3)


def test_under_jit_and_vmap():
    p = problem(6)
    plain = given(p)
    stacked = [jnp.stack([jnp.asarray(p[k])] * 2) for k in p]
    both = jax.jit(jax.vmap(table))(*stacked)
    np.testing.assert_allclose(both.gram[1], plain.gram, rtol=1e-10, atol=1e-10)


def test_transients_that_are_alike_are_factored():
    column = np.linspace(1, 2, 20)[:, None] * 1e12
    for pair in (np.hstack([column, column]), np.hstack([column, column + 1.0])):
        gram = pair.T @ pair
        lower, size = (np.asarray(x) for x in factor_of(jnp.asarray(gram)))
        whole = size[:, None] * (lower @ lower.T) * size
        np.testing.assert_allclose(whole, gram, rtol=3e-12)
    plain = np.array([[3.0, 1.0], [1.0, 2.0]])
    lower, size = (np.asarray(x) for x in factor_of(jnp.asarray(plain)))
    np.testing.assert_allclose(size[:, None] * (lower @ lower.T) * size, plain + np.eye(2), rtol=3e-12)
