"""Mass, damping and stiffness that fit the in-band lines of the records best.

With Z(s) = M s^2 + D s + K, the model of line k is (H_d + s H_v + s^2 H_a) Z(s)^-1 B U_k at s = j w_k, and its
derivative to any entry of M, D, K is minus an outer product of two solutions with Z, so Jacobians cost little.
The hold of the inputs is exact: what a sampled system does beyond its continuous-time frequency response,
G(z) - G_c(s) hold(w), is small and taken from the polished realization. Transients keep the poles of the
polished realization and free amplitudes, which are projected out.

Source: R. Pintelon and J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., ch. 9.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines
from jaxsid.least_squares import levenberg_marquardt
from jaxsid.physical.parameterization import Parameterization, Triple
from jaxsid.records import ContinuousModel, Realization, SecondOrderModel

STEPS = 80


class Target(NamedTuple):
    """What mass, damping and stiffness are fitted to.

    Attributes:
        s: (lines,) j w.
        drive: (lines, inputs) spectrum of the held inputs.
        y: (lines, outputs) measured, less what sampling adds.
        weight: (lines, outputs) one over the noise, 0 where nothing was measured.
        transient: (2 lines, free, outputs) orthonormal basis of the weighted transients, real over imaginary.
    """

    s: Complex[Array, " lines"]
    drive: Complex[Array, "lines inputs"]
    y: Complex[Array, "lines outputs"]
    weight: Float[Array, "lines outputs"]
    transient: Float[Array, "twice free outputs"]


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
    """The lines as continuous-time data, with the transients' basis.

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
    poles = jnp.linalg.eigvals(realization.A)
    weight = lines.weight * jnp.sqrt(2.0) / noise
    parts = 1 / (lines.z[:, None] - poles)
    # conjugate pairs: sums and differences over j have real coefficients
    mirrored = 1 / (lines.z[:, None] - poles.conj())
    basis = jnp.concatenate([parts + mirrored, 1j * (parts - mirrored), jnp.ones((len(s), 1))], axis=1)
    basis = (basis[:, :, None] * lines.record[:, None, :]).reshape(len(s), -1)
    # one output after another: batched factorizations side by side can lock up the CPU's thread pool
    transient = jax.lax.map(lambda w: _orthonormal(basis * w[:, None]), weight.T)
    return Target(s, drive, lines.y - excess, weight, jnp.moveaxis(transient, 0, 2))


def _orthonormal(x: Array) -> Array:
    """Orthonormal basis of the real span of complex columns; empty directions become zero."""
    x = jnp.concatenate([x.real, x.imag])
    u, sv, _ = jnp.linalg.svd(x / jnp.maximum(jnp.linalg.norm(x, axis=0), 1e-300), full_matrices=False)
    return u * (sv > 1e-10 * sv[0])


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
        left = _project(target, (target.y - model)[:, None])[:, 0]
        return left.ravel(), -jnp.moveaxis(_project(target, derivative), 1, 2).reshape(-1, len(theta))

    found = levenberg_marquardt(evaluate, parameterization.unknowns(start), max_steps=STEPS)
    scale = jnp.sqrt(jnp.diag(found.jacobian_product))
    free = (target.transient**2).sum() + len(found.value)
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


def _project(target: Target, x: Array) -> Array:
    """Weighted real and imaginary parts with transients removed, (2 lines, columns, outputs)."""
    x = x * target.weight[:, None, :]
    x = jnp.concatenate([x.real, x.imag])
    return x - jnp.einsum("kfo,fco->kco", target.transient, jnp.einsum("kfo,kco->fco", target.transient, x))
