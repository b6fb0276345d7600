"""What sampling adds to the lines of a held system, as a function of its mass, damping and stiffness.

Fits to lines are in continuous time, where they are cheap. Of the sampled system a line is the sum of all its aliases,
and near the Nyquist frequency most of its phase, and with it what it tells of the masses, comes from them.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex

from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines
from jaxsid.mechanics.inverses import inverse_each
from jaxsid.physical.inband_fit import Sampling, Target, entry_slopes, line_model, upper_triangles
from jaxsid.physical.parameterization import Triple
from jaxsid.physical.terms import sampled_with_slopes
from jaxsid.records import SecondOrderModel


@compiled
def with_sampling(
    target: Target, lines: Lines, matrices: Triple, sensed: SecondOrderModel, fitted: Bool[Array, ""]
) -> Target:
    """The target with what sampling adds to first order about some matrices.

    Args:
        target: from `fit_target`, which takes it from a state-space model.
        lines: what that was made of, with held inputs.
        matrices: M, D, K, from a first fit.
        sensed: gives the input matrix and the sensors.
        fitted: whether the matrices fit the lines; where they do not the target stays as it is, in the same form, so
            that both are fitted to by one program.
    """
    ramps = tuple(h == "first" for h in lines.hold)
    A, B, C, D = sampled_with_slopes(matrices, entry_slopes(len(matrices[0])), sensed, lines.dt, ramps)
    sampled = _driven(A, B, C, D, lines.z, lines.u)
    plain, slopes = line_model(target, matrices, sensed)
    excess, bend = sampled[:, 0] - plain, sampled[:, 1:] - slopes
    y = jnp.where(fitted, lines.y - excess, target.y)
    return target._replace(y=y, sampling=Sampling(upper_triangles(matrices), jnp.where(fitted, bend, 0.0)))


def _driven(
    A: Array, B: Array, C: Array, D: Array, z: Array, u: Array
) -> Complex[Array, "lines stacked outputs"]:
    """(C (z I - A)^-1 B + D) u at every line, then its changes."""
    inverse = inverse_each(z[:, None, None] * jnp.eye(A.shape[1]) - A[0])
    forced = u @ B[0].T
    x = jnp.einsum("knm,km->kn", inverse, forced)
    p = C[0] @ inverse
    pushed = jnp.einsum("dnm,km->kdn", A[1:], x) + jnp.einsum("dni,ki->kdn", B[1:], u)
    change = jnp.einsum("kon,kdn->kdo", p, pushed)
    change = change + jnp.einsum("don,kn->kdo", C[1:], x) + jnp.einsum("doi,ki->kdo", D[1:], u)
    return jnp.concatenate([(x @ C[0].T + u @ D[0].T)[:, None], change], axis=1)
