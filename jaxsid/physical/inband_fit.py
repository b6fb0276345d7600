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
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines
from jaxsid.least_squares import levenberg_marquardt
from jaxsid.mechanics.functions_of_matrices import phi_functions
from jaxsid.physical.parameterization import Parameterization, Triple
from jaxsid.records import ContinuousModel, Realization, SecondOrderModel

STEPS = 80


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
    """

    s: Complex[Array, " lines"]
    x: Complex[Array, " lines"]
    record: Float[Array, "lines records"]
    dt: Float[Array, " records"]
    drive: Complex[Array, "lines inputs"]
    y: Complex[Array, "lines outputs"]
    weight: Float[Array, "lines outputs"]


class MatrixFit(NamedTuple):
    """Fitted matrices, their standard deviations, and the misfit.

    Attributes:
        matrices: M, D, K.
        deviation: standard deviation of every entry.
        misfit: mean square of the weighted residual; 1 when the model explains all but noise.
        covariance: of the unknowns, times the misfit where that is above 1.
        slopes: derivative of every entry of M, D, K to the unknowns, (N, N, p) each.
    """

    matrices: Triple
    deviation: Triple
    misfit: Float[Array, ""]
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

    def evaluate(theta: Array) -> tuple[Array, Array]:
        matrices, slopes = parameterization.matrices(theta), jax.jacfwd(parameterization.matrices)(theta)
        model, derivative = _lines_and_slopes(target, matrices, slopes, sensed)
        return _without_transients(
            target, target.y - model, -derivative, *_motion(target, matrices, slopes), sensed
        )

    found = levenberg_marquardt(evaluate, parameterization.unknowns(start), max_steps=STEPS)
    scale = jnp.sqrt(jnp.diag(found.jacobian_product))
    amplitudes = target.record.shape[1] * (2 * len(sensed.mass) + 1) * target.weight.shape[1]
    free = amplitudes + len(found.value)
    equations = 2 * (target.weight > 0).sum()
    misfit = 2 * found.cost / jnp.maximum(equations - free, 1.0)
    covariance = jnp.linalg.inv(found.jacobian_product / scale / scale[:, None]) / scale / scale[:, None]
    covariance = covariance * jnp.maximum(misfit, 1.0)
    slopes = jax.jacfwd(parameterization.matrices)(found.value)
    d_mass, d_damping, d_stiffness = (
        jnp.sqrt(jnp.maximum(jnp.einsum("ijp,pq,ijq->ij", x, covariance, x), 0.0)) for x in slopes
    )
    return MatrixFit(
        parameterization.matrices(found.value), (d_mass, d_damping, d_stiffness), misfit, covariance, slopes
    )


def _lines_and_slopes(
    target: Target, matrices: Triple, slopes: tuple[Float[Array, "N N p"], ...], sensed: SecondOrderModel
) -> tuple[Array, Array]:
    """Modelled lines (lines, outputs) and their derivatives (lines, unknowns, outputs)."""
    s = target.s[:, None, None]
    M, D, K = matrices
    inverse = jnp.linalg.inv(M * s**2 + D * s + K)
    x = jnp.einsum("kab,kb->ka", inverse, target.drive @ sensed.input_matrix.T)
    seen = sensed.displacement_sensors + s * sensed.velocity_sensors + s**2 * sensed.acceleration_sensors
    p = seen @ inverse
    model = jnp.einsum("koa,ka->ko", seen, x)
    outer = (p[:, :, :, None] * x[:, None, None, :]).reshape(len(x), len(seen[0]), -1)
    flat = [d.reshape(-1, d.shape[-1]).astype(outer.dtype) for d in slopes]
    change = outer @ flat[0] * s**2 + outer @ flat[1] * s + outer @ flat[2]
    return model, -jnp.swapaxes(change, 1, 2)


def _motion(target: Target, matrices: Triple, slopes: tuple[Array, ...]) -> tuple[Array, Array]:
    """F of each record, (records, 2N, 2N), and its derivatives to the unknowns, (records, 2N, 2N, p)."""

    def advance(M: Array, D: Array, K: Array) -> Array:
        per_mass = jnp.linalg.solve(M, jnp.concatenate([-K, -D], axis=1))
        A = jnp.concatenate([jnp.eye(len(M), 2 * len(M), len(M)), per_mass])
        # exp(A dt) = I + A dt phi_1(A dt); for dt = 0 the transients are those of continuous time
        held = jax.vmap(lambda dt: jnp.eye(len(A)) + A * dt @ phi_functions(A * dt)[0])(target.dt)
        return jnp.where(target.dt[:, None, None] > 0, held, A)

    F, push = jax.linearize(advance, *matrices)
    return F, jax.vmap(push, in_axes=-1, out_axes=-1)(*slopes)


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
    inverse = jnp.linalg.inv(target.x[:, None, None] * jnp.eye(F.shape[1]) - F)
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
