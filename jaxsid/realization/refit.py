"""Inputs and feedthrough of a realization, by least squares against the lines of its records.

With A and C kept, Y(k) = C (z_k - A)^-1 (B U(k) + z_k T_e) + D U(k) is linear in B, D and the transient T_e of
each record e (state at the start less state at the end, over sqrt(samples)); with hold "band", where z is the
bilinear map of j w, z_k + 1 stands before T_e. One least-squares problem, by a QR factorization for each output
in turn. It undoes what truncation of a Hankel matrix costs B, which was chosen for the impulse response and
not for the records.

Source: P. Van Overschee and B. De Moor, Subspace Identification for Linear Systems, Kluwer 1996, ch. 4;
T. McKelvey, H. Akcay, L. Ljung, "Subspace-based multivariable system identification from frequency
response data", IEEE Trans. Automatic Control 41 (1996).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.impulse.lines import Lines
from jaxsid.records import Realization


def refit_inputs(realization: Realization, lines: Lines) -> Realization:
    """The realization with B and D that explain the lines best, A and C kept; outputs weigh alike.

    min over B, D, T of sum_ik |Y_i(k) - C_i (z_k - A)^-1 (B U(k) + z_k T_e) - D_i U(k)|^2 / norm(Y_i)^2.

    Args:
        realization: model of the lines' inputs and outputs, at their sampling interval.
        lines: in-band lines of its records.

    Returns:
        Realization without the factors of its Hankel matrix, which belong to another B.

    Raises:
        InputError: the realization has other inputs or outputs than the lines.
    """
    (outputs, inputs), needed = realization.D.shape, (lines.y.shape[1], lines.u.shape[1])
    require(
        (outputs, inputs) == needed,
        f"the realization has {outputs} outputs and {inputs} inputs, the lines have {needed[0]} and {needed[1]}.",
    )
    B, D = _refit(realization.A, realization.C, lines)
    return Realization(
        realization.A, B, realization.C, D, realization.dt, pole=realization.pole, hold=realization.hold
    )


@compiled
def _refit(
    A: Float[Array, "n n"], C: Float[Array, "m n"], lines: Lines
) -> tuple[Float[Array, "n r"], Float[Array, "m r"]]:
    inputs, n = lines.u.shape[1], len(A)
    start = lines.z + 1 if "band" in lines.hold else lines.z
    drive = jnp.concatenate([lines.u, start[:, None] * lines.record], axis=1)
    unknowns = n * drive.shape[1]

    def add(triangle: Array, output: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        """The equations of one output: D's own rows come first, the rest joins what B and T must satisfy."""
        free, y, weight = output
        forced = (drive[:, :, None] * free[:, None, :]).reshape(len(y), -1)
        table = jnp.concatenate([lines.u, forced, y[:, None]], axis=1) * weight[:, None]
        size = jnp.linalg.norm(table[:, -1])
        own = jnp.linalg.qr(_real(table) / jnp.where(size > 0, size, 1.0), mode="r")
        rest = jnp.linalg.qr(jnp.concatenate([triangle, own[inputs:, inputs:]]), mode="r")
        return rest, own[:inputs]

    free = jnp.swapaxes(_free_responses(A, C, lines.z), 0, 1)
    triangle, own = jax.lax.scan(
        add, jnp.zeros((unknowns + 1, unknowns + 1), A.dtype), (free, lines.y.T, lines.weight.T)
    )
    scale = jnp.linalg.norm(triangle[:, :-1], axis=0)
    scale = jnp.where(scale > 0, scale, 1.0)
    x = jnp.linalg.lstsq(triangle[:, :-1] / scale, triangle[:, -1])[0] / scale
    left = own[:, :, -1] - own[:, :, inputs:-1] @ x
    D = jax.lax.map(lambda pair: jnp.linalg.lstsq(*pair)[0], (own[:, :, :inputs], left))
    return x[: n * inputs].reshape(inputs, n).T, D


def _free_responses(A: Array, C: Array, z: Array) -> Complex[Array, "lines m n"]:
    """C (z - A)^-1 at each line, one small solve after another."""
    eye = jnp.eye(len(A), dtype=A.dtype)
    return jax.lax.map(lambda point: jnp.linalg.solve((point * eye - A).T, C.T.astype(z.dtype)).T, z)


def _real(x: Array) -> Array:
    return jnp.concatenate([x.real, x.imag])
