"""Mass, damping and stiffness that fit the in-band lines of the records best.

With Z(s) = M s^2 + D s + K, the model of line k is (H_d + s H_v + s^2 H_a) Z(s)^-1 B U_k at s = j w_k, and its
derivative to any entry of M, D, K is minus an outer product of two solutions with Z, so Jacobians cost little.
The hold of the inputs is exact: what a sampled system does beyond its continuous-time frequency response,
G(z) - G_c(s) hold(w), is small and taken from the polished realization. The transients of an output are
e' (x I - F)^-1 a + b with the system's own F, read at the body of its sensor, and free a and b for each record: they
are projected out as in variable projection, so that what they tell of the poles counts once.

Source: R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., ch. 9; G. Golub
and V. Pereyra, SIAM J. Numer. Anal. 10 (1973), with L. Kaufman's simplification (BIT 15, 1975).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines
from jaxsid.least_squares import levenberg_marquardt
from jaxsid.mechanics.functions_of_matrices import exponential_with_slopes
from jaxsid.mechanics.inverses import inverse_each
from jaxsid.physical.parameterization import BLIND, Parameterization, Slopes, Triple
from jaxsid.records import ContinuousModel, Realization, SecondOrderModel

STEPS = 200
# An unknown that moves M, D, K less than this, next to the one that moves them most, is at an edge.
STILL = 1e-4


class Target(NamedTuple):
    """What mass, damping and stiffness are fitted to.

    Attributes:
        s: (lines,) j w.
        x: (lines,) where the transients are rational functions: z, or s for band-limited inputs.
        record: (lines, records) which record a line belongs to.
        dt: (records,) the interval of each, after which F = exp(A dt), for x = z; 0 for x = s, where F = A.
        drive: (lines, inputs) spectrum of the held inputs.
        y: (lines, outputs) measured, less what sampling adds.
        weight: (lines, outputs) one over the noise, 0 where nothing was measured.
        sampling: how what sampling adds changes with M, D, K; None where it is taken for given.
    """

    s: Complex[Array, " lines"]
    x: Complex[Array, " lines"]
    record: Float[Array, "lines records"]
    dt: Float[Array, " records"]
    drive: Complex[Array, "lines inputs"]
    y: Complex[Array, "lines outputs"]
    weight: Float[Array, "lines outputs"]
    sampling: "Sampling | None" = None


class Sampling(NamedTuple):
    """What sampling adds to lines, to first order.

    Attributes:
        about: (entries,) upper triangles of the M, D, K that it is zero at: there `Target.y` has it subtracted.
        slopes: (lines, entries, outputs) by these.
    """

    about: Float[Array, " entries"]
    slopes: Complex[Array, "lines entries outputs"]


class MatrixFit(NamedTuple):
    """Fitted matrices, their standard deviations, and the misfit.

    Attributes:
        matrices: M, D, K.
        deviation: standard deviation of every entry.
        misfit: mean square of the weighted residual; 1 when the model explains all but noise.
        squares: sum of the squares of the weighted residual.
        excess: by how much `squares` would fall were every entry of symmetric M, D, K free, to first order.
        reach: number of combinations of these entries that the lines tell of.
        unknowns: (p,) those of the parameterization.
        information: J'J of the weighted residual to the unknowns.
        covariance: of the unknowns, times the misfit where that is above 1.
        slopes: derivative of every entry of M, D, K to the unknowns, (N, N, p) each.
    """

    matrices: Triple
    deviation: Triple
    misfit: Float[Array, ""]
    squares: Float[Array, ""]
    excess: Float[Array, ""]
    reach: Int[Array, ""]
    unknowns: Float[Array, " p"]
    information: Float[Array, "p p"]
    covariance: Float[Array, "p p"]
    slopes: tuple[Float[Array, "N N p"], Float[Array, "N N p"], Float[Array, "N N p"]]


@compiled
def fit_target(
    lines: Lines,
    noise: Float[Array, "lines outputs"],
    realization: Realization,
    model: ContinuousModel,
) -> Target:
    """The lines as continuous-time data.

    Args:
        lines: in-band lines.
        noise: (lines, outputs) standard deviation of the noise.
        realization: polished.
        model: the same in continuous time.
    """
    s = 1j * lines.omega
    half = s * lines.dt / 2
    hold = jnp.where(jnp.abs(half) > 0, jnp.sinh(half) / jnp.where(jnp.abs(half) > 0, half, 1.0), 1.0)
    factors = {"zero": hold * jnp.exp(-half), "first": hold**2, "band": jnp.ones_like(hold)}
    drive = lines.u * jnp.stack([factors[h] for h in lines.hold], axis=1)
    sampled = _modal_response(realization, lines.z, lines.u)
    excess = sampled - _modal_response(model, s, drive)
    weight = lines.weight * jnp.sqrt(2.0) / noise
    band = "band" in lines.hold
    dt = jnp.asarray(lines.record_dt, weight.dtype) * (not band)
    x = s if band else jnp.exp(s * (lines.record @ dt))
    return Target(s, x, lines.record, dt, drive, lines.y - excess, weight)


def _modal_response(model: Realization | ContinuousModel, points: Array, u: Array) -> Array:
    """(C (x I - A)^-1 B + D) u at many points x, through the eigenvectors of A."""
    values, vectors = jnp.linalg.eig(model.A)
    driven = u @ jnp.linalg.solve(vectors, model.B.astype(vectors.dtype)).T
    return (driven / (points[:, None] - values)) @ (model.C @ vectors).T + u @ model.D.T


@compiled
def fit_matrices(
    target: Target, parameterization: Parameterization, start: Triple, sensed: SecondOrderModel
) -> MatrixFit:
    """Unknowns of a parameterization that minimize the weighted squares of the lines' residual.

    Args:
        target: from `fit_target`.
        parameterization: what may vary.
        start: M, D, K to begin with.
        sensed: gives the input matrix and the sensors; its matrices are not used.
    """
    size = len(sensed.mass)

    def entries(theta: Array) -> Array:
        return upper_triangles(parameterization.matrices(theta))

    def evaluate(upper: Array) -> tuple[Array, Array]:
        return line_residual(target, _symmetric(upper, size), sensed)

    theta = parameterization.unknowns(start)
    found = levenberg_marquardt(evaluate, theta, max_steps=STEPS, through=entries)
    amplitudes = target.record.shape[1] * (2 * size + 1) * target.weight.shape[1]
    free = amplitudes + len(found.value)
    equations = 2 * (target.weight > 0).sum()
    misfit = 2 * found.cost / jnp.maximum(equations - free, 1.0)
    both = jax.vmap(jax.jacfwd(parameterization.matrices))(jnp.stack([theta, found.value]))
    before, slopes = tuple(x[0] for x in both), tuple(x[1] for x in both)
    covariance = _covariance(found.jacobian_product, before, slopes) * jnp.maximum(misfit, 1.0)
    d_mass, d_damping, d_stiffness = (
        jnp.sqrt(jnp.maximum(jnp.einsum("ijp,pq,ijq->ij", x, covariance, x), 0.0)) for x in slopes
    )
    return MatrixFit(
        parameterization.matrices(found.value),
        (d_mass, d_damping, d_stiffness),
        misfit,
        2 * found.cost,
        *_score(found.seen_product, found.seen_gradient),
        found.value,
        found.jacobian_product,
        covariance,
        slopes,
    )


def line_residual(target: Target, matrices: Triple, sensed: SecondOrderModel) -> tuple[Array, Array]:
    """Weighted residual (equations,) and its Jacobian to the upper triangles of M, D, K, transients projected out.

    Args:
        target: the lines.
        matrices: M, D, K.
        sensed: gives the input matrix and the sensors.
    """
    model, slopes = line_model(target, matrices, sensed)
    if target.sampling is not None:
        moved = upper_triangles(matrices) - target.sampling.about
        model = model + jnp.einsum("keo,e->ko", target.sampling.slopes, moved)
        slopes = slopes + target.sampling.slopes
    return _without_transients(target, target.y - model, -slopes, *_motion(target, matrices), sensed)


def _score(product: Array, gradient: Array) -> tuple[Array, Array]:
    """g' (J'J)^-1 g, the score statistic, and the rank of J'J.

    Source: C. R. Rao, Proc. Cambridge Phil. Soc. 44 (1948).
    """
    scale = jnp.sqrt(jnp.diag(product))
    scale = jnp.where(scale > 0, scale, 1.0)
    values, vectors = jnp.linalg.eigh(product / scale / scale[:, None])
    told = values > BLIND * values[-1]
    along = vectors.T @ (gradient / scale)
    return jnp.where(told, along**2 / jnp.where(told, values, 1.0), 0.0).sum(), told.sum()


def _covariance(product: Array, before: tuple[Array, ...], slopes: tuple[Array, ...]) -> Array:
    """Inverse of J'J over the unknowns that move M, D, K; at the edge of what is allowed some no longer do.

    Args:
        product: J'J.
        before: slopes of M, D, K at the start, well inside.
        slopes: where the fit ended.
    """
    usual, moved = (jnp.concatenate([s.reshape(-1, s.shape[-1]) for s in x]) for x in (before, slopes))
    size = jnp.linalg.norm(usual, axis=1, keepdims=True)
    moved = moved / jnp.where(size > 0, size, 1.0)
    reach, directions = jnp.linalg.eigh(moved.T @ moved)
    directions = directions * (reach > STILL**2 * reach[-1])
    within = directions.T @ product @ directions
    scale = jnp.sqrt(jnp.diag(within))
    scale = jnp.where(scale > 0, scale, 1.0)
    within = within / scale / scale[:, None] + jnp.diag(1.0 * (jnp.diag(within) == 0))
    directions = directions / scale
    return directions @ jnp.linalg.solve(within, directions.T)


def upper_triangles(matrices: Triple) -> Float[Array, " entries"]:
    """Of M, D, K, row by row."""
    return jnp.concatenate([x[np.triu_indices(len(x))] for x in matrices])


def entry_slopes(size: int) -> Slopes:
    """(entries, N, N) changes of M, D, K with each entry of their upper triangles."""
    return _symmetric(jnp.eye(3 * size * (size + 1) // 2), size)


def _symmetric(upper: Float[Array, "*shape entries"], size: int) -> tuple[Array, Array, Array]:
    """M, D, K from their upper triangles, row by row, (..., entries)."""
    at = np.zeros((size, size), int)
    at[np.triu_indices(size)] = np.arange(size * (size + 1) // 2)
    at = np.maximum(at, at.T)
    M, D, K = (x[..., at] for x in jnp.split(upper, 3, axis=-1))
    return M, D, K


def _state_matrix(matrices: Triple) -> Array:
    """A of displacements and velocities, (2N, 2N)."""
    M, D, K = matrices
    per_mass = jnp.linalg.solve(M, jnp.concatenate([-K, -D], axis=1))
    return jnp.concatenate([jnp.eye(len(M), 2 * len(M), len(M)), per_mass])


def line_model(target: Target, matrices: Triple, sensed: SecondOrderModel) -> tuple[Array, Array]:
    """Lines in continuous time (lines, outputs), and derivatives (lines, entries, outputs) to the upper triangles.

    Args:
        target: frequencies and inputs.
        matrices: M, D, K.
        sensed: gives the input matrix and the sensors.
    """
    s = target.s[:, None, None]
    M, D, K = matrices
    inverse = inverse_each(M * s**2 + D * s + K)
    x = jnp.einsum("kab,kb->ka", inverse, target.drive @ sensed.input_matrix.T)
    seen = sensed.displacement_sensors + s * sensed.velocity_sensors + s**2 * sensed.acceleration_sensors
    p = jnp.swapaxes(seen @ inverse, 1, 2)
    model = jnp.einsum("koa,ka->ko", seen, x)
    i, j = np.triu_indices(len(M))
    x = x[:, :, None]
    change = p[:, i] * x[:, j] + jnp.where((i != j)[:, None], p[:, j] * x[:, i], 0.0)
    return model, -jnp.concatenate([change * s**2, change * s, change], axis=1)


def _motion(target: Target, matrices: Triple) -> tuple[Array, Array]:
    """F of each record, (records, 2N, 2N), and its derivatives to the upper triangles, (records, 2N, 2N, entries)."""
    M, _, K = matrices
    size = len(M)
    A = _state_matrix(matrices)
    one = entry_slopes(size)
    pushed = -jnp.linalg.solve(M, jnp.concatenate([one[2], one[1]], axis=2) + one[0] @ A[size:])
    stack = jnp.concatenate([A[None], jnp.concatenate([jnp.zeros_like(pushed), pushed], axis=1)])
    # displacements in units in which they are about as large as velocities
    rate = jnp.sqrt(jnp.trace(K) / jnp.trace(M))
    units = jnp.where(jnp.arange(2 * size) < size, 1.0, jnp.where(rate > 0, rate, 1.0))
    levelled = stack * units / units[:, None]
    held = jax.lax.map(lambda dt: exponential_with_slopes(levelled * dt), target.dt)
    held = held * units[:, None] / units
    # for dt = 0 the transients are those of continuous time
    every = jnp.where(target.dt[:, None, None, None] > 0, held, stack)
    return every[:, 0], jnp.moveaxis(every[:, 1:], 1, -1)


def _without_transients(
    target: Target, left: Array, slopes: Array, F: Array, dF: Array, sensed: SecondOrderModel
) -> tuple[Array, Array]:
    """Weighted residual (equations,) and Jacobian (equations, p) with the transients projected out.

    Args:
        target: the lines.
        left: (lines, outputs) measured less modelled.
        slopes: (lines, p, outputs) its derivative.
        F: of the transients.
        dF: its derivative.
        sensed: gives the sensors.
    """
    F = jnp.einsum("kr,rnm->knm", target.record, F)
    inverse = inverse_each(target.x[:, None, None] * jnp.eye(F.shape[1]) - F)
    pushes = dF.reshape(len(dF), -1, dF.shape[-1])
    places = sensed.displacement_sensors + sensed.velocity_sensors + sensed.acceleration_sensors
    constant = target.record.astype(inverse.dtype)

    def one_output(given: tuple[Array, ...]) -> tuple[Array, Array]:
        y, weight, slope, place = given
        row = jnp.einsum("n,knm->km", place, inverse[:, : len(place)])
        basis = (row[:, None, :] * target.record[:, :, None]).reshape(len(row), -1)
        q, amplitude = _amplitudes(
            _parts(jnp.concatenate([basis, constant], axis=1), weight), _parts(y, weight)
        )
        state = amplitude[: basis.shape[1]].reshape(target.record.shape[1], -1)
        moved = jnp.einsum("knm,km->kn", inverse, target.record @ state)
        outer = (row[:, :, None] * moved[:, None, :]).reshape(len(row), -1)
        change = jnp.einsum("kr,kq,rqp->kp", target.record, outer, pushes)
        r, j = _parts(y, weight), _parts(slope - change, weight)
        return r - q @ (q.T @ r), j - q @ (q.T @ j)

    # one output after another: batched factorizations side by side can lock up the CPU's thread pool
    r, j = jax.lax.map(one_output, (left.T, target.weight.T, jnp.moveaxis(slopes, 2, 0), places))
    return r.ravel(), j.reshape(-1, j.shape[-1])


def _amplitudes(basis: Array, y: Array) -> tuple[Array, Array]:
    """Orthonormal basis of real columns and the coefficients of y in the columns; empty directions become zero."""
    size = jnp.linalg.norm(basis, axis=0)
    size = jnp.where(size > 0, size, 1.0)
    u, sv, vt = jnp.linalg.svd(basis / size, full_matrices=False)
    seen = sv > 1e-10 * sv[0]
    inner = jnp.where(seen, u.T @ y / jnp.where(seen, sv, 1.0), 0.0)
    return u * seen, vt.T @ inner / size


def _parts(x: Array, weight: Array) -> Array:
    """Weighted real over imaginary parts."""
    x = x * weight.reshape(-1, *[1] * (x.ndim - 1))
    return jnp.concatenate([x.real, x.imag])
