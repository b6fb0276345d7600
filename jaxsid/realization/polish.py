"""Maximum-likelihood refinement of a realization against the in-band lines of its records.

With the poles given, residues, feedthrough and the transients of every record enter linearly, so only the
poles are searched: variable projection. Poles enter in pairs through w^2 + a_1 w + a_2, which crosses from
complex to real without a break, so overdamped modes need no special care:
    min sum_k |V_i(k) (Y_i(k) - sum_q (R_q + S_q w_k) / (w_k^2 + a_1q w_k + a_2q) [U(k); 1] - E [U(k); 1])|^2
    ,
the weights V_i(k) being one over the noise level of output i around line k, found from the residual.

Source: G. Golub and V. Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems
whose variables separate", SIAM J. Numer. Anal. 10 (1973), with L. Kaufman's simplification (BIT 15, 1975).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines, laguerre_shift, line_level
from jaxsid.least_squares import forward, levenberg_marquardt
from jaxsid.realization.elimination import mirrored
from jaxsid.realization.era import era
from jaxsid.records import ImpulseResponse, Realization, as_array

STEPS = 30
ROUGH, FINE = (
    1e-5,
    1e-10,
)  # relative gain that ends a fit: while the noise spectrum is still a guess, and the last
EDGE = 1.001  # largest size of a pole in the Laguerre shift: room for a rigid body in noise
LONGEST = 200  # Markov parameters of the refined model
HIDING = 1e3  # growth within the Markov parameters that leaves the other modes their digits
FASTEST = 0.01  # least real pole z: what is faster is gone after a sample, and below 0 it alternates in sign


class Polished(NamedTuple):
    """A refined realization and what the records left over.

    Attributes:
        realization: of the same order and Laguerre pole as the one it started from.
        noise: (lines, outputs) standard deviation of the noise on each line, smoothed over frequency.
        residual: (lines, outputs) what remains of each line.
        transient: (lines, outputs) the part of each line due to the initial and final states.
        denominators: (n,) a_1, a_2 of each pole pair in the Laguerre shift, then minus the odd real pole.
        pole_covariance: (n, n) covariance of the denominators.
    """

    realization: Realization
    noise: Float[Array, "lines outputs"]
    residual: Complex[Array, "lines outputs"]
    transient: Complex[Array, "lines outputs"]
    denominators: Float[Array, " n"]
    pole_covariance: Float[Array, "n n"]


def polish(
    poles: Complex[np.ndarray, " n"], lines: Lines, *, stable: bool = True, rounds: int = 2
) -> Polished:
    """A realization of the same order whose poles, residues and transients fit the lines best.

    Args:
        poles: z, with all conjugates, to start from.
        lines: in-band lines of the records.
        stable: keep every pole inside the unit circle, where noise alone might put it outside.
        rounds: how often the noise spectrum is estimated anew and the fit repeated.
    """
    pole = lines.pole
    least = _least(lines)
    limits = as_array(np.array([least, EDGE if stable else np.inf]))
    theta = as_array(_denominators(poles, float(pole), float(least), stable))
    noise = _first_noise(lines)
    for left in reversed(range(rounds + 1)):
        tolerance = as_array(np.array(ROUGH if left else FINE))
        theta, noise, response, residual, transient, covariance = _fit(
            lines, theta, noise, pole, limits, tolerance
        )
    samples = max(4 * len(theta) + 2, _samples(np.asarray(theta)))
    h = _markov_parameters(theta, response, lines.u.shape[1], samples)
    ir = ImpulseResponse(h, lines.dt, pole=pole, band=lines.band, hold=lines.hold, method="polished in band")
    refined = era(ir, order=len(theta), rows=samples // 2 - 1, cols=samples // 2 - 1)
    return Polished(refined, noise, residual, transient, theta, covariance)


def _samples(theta: np.ndarray) -> int:
    """Markov parameters that show the slowest mode, fewer where a pole outside of the circle would hide the rest."""
    pairs = len(theta) // 2
    roots = [np.roots([1.0, *theta[2 * i : 2 * i + 2]]) for i in range(pairs)] + [-theta[2 * pairs :]]
    growth = np.log(max(np.abs(np.concatenate(roots)).max(), 1.0))
    return int(min(LONGEST, np.log(HIDING) / growth)) if growth > 0 else LONGEST


def _denominators(poles: np.ndarray, pole: float, least: float, stable: bool) -> np.ndarray:
    """Coefficients a_1, a_2 of each pole pair in the shift w, then the odd real pole if there is one."""
    eigenvalues = laguerre_shift(np.asarray(poles, complex), pole)
    eigenvalues = mirrored(eigenvalues) if stable else eigenvalues
    height = np.imag(eigenvalues)
    above, real = eigenvalues[height > 1e-12], np.real(eigenvalues[np.abs(height) <= 1e-12])
    real = list(np.sort(np.maximum(real, 0.9 * least)))
    pairs = [(-2 * p.real, abs(p) ** 2) for p in above]
    while len(real) > 1:  # slowest with fastest, so that no pair starts as a double pole
        low, high = real.pop(0), real.pop()
        pairs.append((-(low + high), low * high))
    return np.concatenate([np.ravel(pairs), [-p for p in real]])


def _least(lines: Lines) -> float:
    """The least real pole: gone after a sample for held inputs, any for band-limited ones."""
    return -1.0 if "band" in lines.hold else float(laguerre_shift(np.array([FASTEST]), float(lines.pole))[0])


def _possible(theta: Array, limits: Array) -> Array:
    """Whether a passive system, sampled, can have these poles: none grows, no real one alternates in sign.

    Poles elsewhere may fit the lines of a band as well.

    Args:
        theta: denominators.
        limits: the least real pole and the largest size of any, in the Laguerre shift.
    """
    least, edge = limits
    pairs = len(theta) // 2
    a1, a2 = theta[: 2 * pairs].reshape(pairs, 2).T
    single = -theta[2 * pairs :]
    stable = (a2 < edge**2) & (jnp.abs(a1) < edge + a2 / edge)
    steady = (a1**2 < 4 * a2) | ((least**2 + a1 * least + a2 > 0) & (-a1 / 2 > least))
    return (stable & steady).all() & ((jnp.abs(single) < edge) & (single > least)).all()


def _sections(theta: Array, w: Array) -> Array:
    """Basis of the partial fractions at points w: w/q and 1/q for each pair, 1/(w - p), and 1."""
    pairs = len(theta) // 2
    a1, a2 = theta[: 2 * pairs].reshape(pairs, 2).T
    inverse = 1 / (w[:, None] ** 2 + a1 * w[:, None] + a2)
    single = 1 / (w[:, None] + theta[2 * pairs :])
    return jnp.concatenate([inverse * w[:, None], inverse, single, jnp.ones((len(w), 1))], axis=1)


def _design(theta: Array, lines: Lines, pole: Array) -> Array:
    """Every section driven by every input, and by the unit line spectrum of each record's transient."""
    drive = jnp.concatenate([lines.u, lines.record], axis=1)
    sections = _sections(theta, laguerre_shift(lines.z, pole))
    return (sections[:, :, None] * drive[:, None, :]).reshape(len(drive), -1)


def _weighted(x: Array, weight: Array) -> Array:
    """Real and imaginary parts, one weight a line."""
    x = x * weight.reshape(-1, *[1] * (x.ndim - 1))
    return jnp.concatenate([x.real, x.imag])


def _projected_residual(theta: Array, args: tuple[Lines, Array, Array]) -> Array:
    """Weighted residual with all linear coefficients eliminated; its derivative is Kaufman's."""
    lines, noise, pole = args
    design = _design(theta, lines, pole)

    def one_output(y: Array, weight: Array) -> Array:
        q, _, coefficients = jax.lax.stop_gradient(_solve(design, y, weight))
        left = _weighted(y - design @ coefficients, weight)
        return left - q @ (q.T @ left)

    # one output after another: batched factorizations side by side can lock up the CPU's thread pool
    weight = lines.weight * jnp.sqrt(2.0) / noise
    return jax.lax.map(lambda pair: one_output(*pair), (lines.y.T, weight.T))


def _solve(design: Array, y: Array, weight: Array) -> tuple[Array, Array, Array]:
    """QR factors and least-squares coefficients of one output, columns scaled to unit norm."""
    weighted = _weighted(design, weight)
    scale = jnp.linalg.norm(weighted, axis=0)
    scale = jnp.where(scale > 0, scale, 1.0)
    q, triangle = jnp.linalg.qr(weighted / scale)
    diagonal = jnp.diag(triangle)
    dead = jnp.abs(diagonal) < 1e-13 * jnp.abs(diagonal).max()
    triangle = triangle + jnp.diag(jnp.where(dead, 1e300, 0.0).astype(triangle.dtype))
    x = jax.scipy.linalg.solve_triangular(triangle, q.T @ _weighted(y, weight))
    return q, triangle, x / scale


@compiled
def _first_noise(lines: Lines) -> Array:
    """The same level for all lines of an output, as long as nothing is known."""
    power = (jnp.abs(lines.y) ** 2 * lines.weight).sum(axis=0) / jnp.maximum(lines.weight.sum(axis=0), 1.0)
    return jnp.broadcast_to(jnp.sqrt(power), lines.y.shape)


@compiled
def _fit(
    lines: Lines, theta: Array, noise: Array, pole: Array, limits: Array, tolerance: Array
) -> tuple[Array, ...]:
    """Poles for a given noise spectrum, then the linear coefficients, the residual and the new spectrum."""
    args = (lines, noise, pole)
    both = forward(lambda t: _projected_residual(t, args))

    def evaluate(t: Array) -> tuple[Array, Array]:
        residual, jacobian = both(t)
        return jnp.where(_possible(t, limits), residual, jnp.inf), jacobian

    found = levenberg_marquardt(evaluate, theta, max_steps=STEPS, tolerance=tolerance)
    theta, covariance = found.value, jnp.linalg.inv(found.jacobian_product)
    design = _design(theta, lines, pole)
    weight = lines.weight / noise

    def one_output(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        q, _, coefficients = _solve(design, *pair)
        return coefficients, (q**2).sum(axis=1).reshape(2, -1).mean(axis=0)

    response, fitted = (x.T for x in jax.lax.map(one_output, (lines.y.T, weight.T)))
    residual = (lines.y - design @ response) * lines.weight
    inputs, records = lines.u.shape[1], lines.record.shape[1]
    response = response.reshape(-1, inputs + records, lines.y.shape[1])
    sections = _sections(theta, laguerre_shift(lines.z, pole))
    transient = jnp.einsum("ks,kr,srm->km", sections, lines.record, response[:, inputs:])
    return theta, line_level(residual, lines.weight, 1 - fitted), response, residual, transient, covariance


@compiled
def _markov_parameters(theta: Array, response: Array, inputs: int, samples: int) -> Array:
    """Markov parameters in the shift w of the partial fractions, (samples, outputs, inputs)."""
    response = response[:, :inputs]
    pairs = len(theta) // 2
    a1, a2 = theta[: 2 * pairs].reshape(pairs, 2).T

    def step(state: Array, _: None) -> tuple[Array, Array]:
        first, second, single = state[:pairs], state[pairs : 2 * pairs], state[2 * pairs :]
        return jnp.concatenate([-a1 * first - a2 * second, first, -theta[2 * pairs :] * single]), state

    start = jnp.concatenate([jnp.ones(pairs), jnp.zeros(pairs), jnp.ones(len(theta) - 2 * pairs)])
    states = jax.lax.scan(step, start, None, length=samples - 1)[1]
    h = jnp.einsum("ks,srm->kmr", states, response[:-1])
    return jnp.concatenate([response[-1].T[None], h])
