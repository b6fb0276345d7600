"""How far each mode of a realization is to be trusted: MAC, MSV, EMAC, MPC and CMI."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled
from jaxsid.records import Indicators, Realization, Steps

FADED = 0.05  # part of its first amplitude below which a mode has nothing left to compare


def mode_indicators(
    realization: Realization,
    eigenvalues: Complex[Array, " n"],
    eigenvectors: Complex[Array, "n n"],
    inverse: Complex[Array, "n n"],
) -> Indicators:
    """The accuracy indicators of the modes (lambda_i, psi_i) of A, against the factors they came from.

    MAC: coherence of the row of Psi^-1 Q with b_i lambda_i^t, Q the controllability factor, b_i its first
    block [4.45-4.50]. MSV: sqrt(|c_i| (1 + |lambda_i| + ... ) |b_i|) over the window [4.51-4.53]. EMAC:
    amplitude ratio and phase of the last block row of P Psi against c_i lambda_i^s, and of the last block
    column of Psi^-1 Q likewise, averaged with the squared components as weights; the product. MPC:
    see `phase_collinearity`. CMI = EMAC MPC. In a Laguerre shift the factors advance by lambda_w = (lambda -
    a) / (1 - a lambda). Where a mode dies out within the window, the last block in which 5 % of it is left takes
    the place of the last one, which would compare noise.

    Args:
        realization: with its observability and controllability factors.
        eigenvalues: of A, (n,).
        eigenvectors: of A, (n, n).
        inverse: of the eigenvectors.

    Source: Juang and Pappa 1985; Pappa, Elliott and Schenk, J. Guidance, Control and Dynamics 16, 1993.
    """
    rz, lam, psi = realization, eigenvalues, eigenvectors
    assert rz.observability is not None
    assert rz.controllability is not None
    lam_w = (lam - rz.pole) / (1 - rz.pole * lam)
    shapes = rz.C @ psi
    outputs = _blocks((rz.observability @ psi).T, len(rz.row_steps))
    inputs = _blocks(inverse @ rz.controllability, len(rz.column_steps))
    b = inverse @ rz.B
    emac_outputs = _consistency(outputs, lam_w, rz.row_steps)
    emac = emac_outputs * _consistency(inputs, lam_w, rz.column_steps)
    mpc = phase_collinearity(shapes)
    window = max(rz.row_steps) + max(rz.column_steps) + 1
    msv = jnp.sqrt(_norm(shapes, 0) * _geometric_sum(jnp.abs(lam), window) * _norm(b, 1))
    return Indicators(_coherence(inputs, lam_w, rz.column_steps), msv, emac, mpc, emac * mpc)


@compiled
def phase_collinearity(shapes: Complex[Array, "outputs n"]) -> Float[Array, " n"]:
    """(2 l_max / (l_1 + l_2) - 1)^2, l the eigenvalues of the covariance of real and imaginary parts.

    1 where the components of a shape lie on a line through 0 in the complex plane.
    """
    x, y = jnp.real(shapes), jnp.imag(shapes)
    xx, yy, xy = (jnp.sum(p * q, axis=0) for p, q in ((x, x), (y, y), (x, y)))
    return _ratio((xx - yy) ** 2 + 4 * xy**2, (xx + yy) ** 2)


def _blocks(rows: Complex[Array, "n all"], count: int) -> Complex[Array, "n count channels"]:
    return rows.reshape(rows.shape[0], count, -1)


def _norm(x: Array, axis: int | tuple[int, ...]) -> Array:
    return jnp.sqrt(jnp.sum(jnp.abs(x) ** 2, axis=axis))


def _ratio(numerator: Array, denominator: Array) -> Array:
    """Their quotient, 0 where there is nothing to compare."""
    empty = denominator == 0
    return jnp.where(empty, 0, numerator / jnp.where(empty, 1, denominator))


def _powers(lam: Complex[Array, " n"], steps: Steps) -> Complex[Array, "n steps"]:
    """lambda^step; a zero eigenvalue has only its zeroth power."""
    steps_array = np.asarray(steps) - steps[0]
    safe = jnp.where(lam == 0, 1, lam)
    powers = jnp.exp(jnp.log(safe)[:, None] * steps_array)
    return jnp.where((lam == 0)[:, None] & (steps_array > 0), 0, powers)


def _coherence(
    blocks: Complex[Array, "n count channels"], lam: Complex[Array, " n"], steps: Steps
) -> Float[Array, " n"]:
    """Modal amplitude coherence between the blocks and the geometric sequence of the first one."""
    expected = blocks[:, :1] * _powers(lam, steps)[:, :, None]
    inner = jnp.abs(jnp.sum(blocks * jnp.conj(expected), axis=(1, 2)))
    return _ratio(inner, _norm(blocks, (1, 2)) * _norm(expected, (1, 2)))


def _consistency(
    blocks: Complex[Array, "n count channels"], lam: Complex[Array, " n"], steps: Steps
) -> Float[Array, " n"]:
    """One half of EMAC: a late block against the first one carried there, in amplitude and phase."""
    first, powers = blocks[:, 0], _powers(lam, steps)
    alive = (jnp.abs(powers) >= FADED) | (jnp.arange(len(steps)) <= 1)
    late = jnp.argmax(jnp.where(alive, np.asarray(steps), -1), axis=1)[:, None]
    found = jnp.take_along_axis(blocks, late[:, :, None], axis=1)[:, 0]
    expected = first * jnp.take_along_axis(powers, late, axis=1)
    sizes = jnp.abs(found), jnp.abs(expected)
    amplitude = _ratio(jnp.minimum(*sizes), jnp.maximum(*sizes))
    phase = jnp.abs(jnp.angle(found * jnp.conj(expected)))
    agreement = amplitude * jnp.maximum(1 - phase / (jnp.pi / 4), 0)
    weight = jnp.abs(first) ** 2
    return _ratio(jnp.sum(agreement * weight, axis=1), jnp.sum(weight, axis=1))


def _geometric_sum(ratio: Float[Array, " n"], count: int) -> Float[Array, " n"]:
    """1 + ratio + ... + ratio^(count - 1), also for a ratio of 1."""
    safe = jnp.where(jnp.abs(ratio - 1) < 1e-9, 2.0, jnp.maximum(ratio, jnp.finfo(ratio.dtype).tiny))
    log = jnp.log(safe)
    return jnp.where(safe == 2.0, count, jnp.expm1(count * log) / jnp.expm1(log))
