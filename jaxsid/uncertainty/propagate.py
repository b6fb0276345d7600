"""First-order covariance (delta method) of what is computed from an impulse response or from its realization.

cov f(h) = J cov(h) J', J = df/dh. For a realization by ERA the derivative has a closed form: with L O = I and Q R = I
for the factors O, Q of the Hankel matrix, A = (L H1 R) (L H0 R)^-1, B = (L H0)[:, :r], C = (H0 R)[:m] (L H0 R)^-1 and
fixed L and R give, at the point itself, all that poles, shapes and physical matrices depend on: turning the subspaces
changes them by products of noise with the discarded singular values only, which is second order.
Source: R. Longman, M. Bergmann, J.-N. Juang, variance and bias of ERA parameters, AIAA 88-4200; J.-N. Juang, Applied
System Identification, 1994.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import laguerre_to_shift, shift_to_laguerre
from jaxsid.realization.hankel import fast_length
from jaxsid.records import ImpulseResponse, Realization, Steps
from jaxsid.uncertainty.noise import ResponseNoise


class Propagated(NamedTuple):
    """A result with its first-order spread.

    Attributes:
        value: what the function gave.
        deviation: standard deviations in the same arrangement; of a complex number those of its real and imaginary
            part, as a complex number.
        covariance: (p, p), of all numbers of the result in a row, complex ones as real and imaginary part, arrays
            in the order of `jax.tree.leaves`.
    """

    value: Any
    deviation: Any
    covariance: Float[Array, "p p"]


def propagate(
    function: Callable[[Realization], Any], realization: Realization, noise: ResponseNoise, *, samples: int
) -> Propagated:
    """Covariance of a function of a realization by ERA, from that of its impulse response.

    J = (df/dA, df/dB, df/dC, df/dD) d(A, B, C, D)/dh, the second in closed form at fixed subspaces.

    Args:
        function: of a realization, to real or complex arrays that do not depend on the basis of its states, such as
            poles, frequencies, shapes, M, D, K; not the entries of A, B and C themselves.
        realization: by `era`, with its factors.
        noise: covariance of the impulse response.
        samples: length of that impulse response.

    Raises:
        InputError: the realization carries no factors.
    """
    require(
        realization.observability is not None and len(realization.row_steps) > 0,
        "propagate needs a realization by era, which carries the factors of its Hankel matrix.",
    )
    last = max(realization.row_steps) + max(realization.column_steps) + 2
    require(
        samples > last,
        f"the realization used {last + 1} samples of an impulse response, not {samples} or fewer.",
    )
    return _propagate(function, realization, noise, samples)


def propagate_response(
    function: Callable[[ImpulseResponse], Any], response: ImpulseResponse, noise: ResponseNoise
) -> Propagated:
    """Covariance of any differentiable function of an impulse response, by reverse differentiation.

    Args:
        function: of an impulse response, to real or complex arrays; ERA/DC and other chains have derivatives too.
        response: where to differentiate.
        noise: its covariance.
    """
    return _propagate_response(function, response, noise)


@compiled
def _propagate_response(function: Callable, response: ImpulseResponse, noise: ResponseNoise) -> Propagated:
    def flat(h: Array) -> tuple[Array, Any]:
        value = function(_with_samples(response, h))
        return _real_row(value), value

    rows, value = jax.jacrev(flat, has_aux=True)(response.h)
    return _result(value, noise.covariance(rows))


def _with_samples(response: ImpulseResponse, h: Array) -> ImpulseResponse:
    return ImpulseResponse(
        h, response.dt, pole=response.pole, band=response.band, hold=response.hold, method=response.method
    )


@compiled
def _propagate(
    function: Callable, realization: Realization, noise: ResponseNoise, samples: int
) -> Propagated:
    pole = realization.pole
    point = shift_to_laguerre(realization.A, realization.B, realization.C, realization.D, pole)

    def flat(matrices: tuple[Array, Array, Array, Array]) -> tuple[Array, Any]:
        A, B, C, D = laguerre_to_shift(matrices[0], matrices[1], matrices[2], matrices[3], pole)
        value = function(Realization(A, B, C, D, realization.dt, hold=realization.hold))
        return _real_row(value), value

    slopes, value = jax.jacrev(flat, has_aux=True)(point)
    return _result(value, noise.covariance(_response_rows(realization, point, slopes, samples)))


def _response_rows(
    realization: Realization, point: tuple[Array, ...], slopes: tuple[Array, ...], samples: int
) -> Float[Array, "p samples outputs inputs"]:
    """Derivative to the samples from the derivatives to A, B, C, D in the shift of the samples.

    dA = L dH1 R - A X, dC = (dH0 R)[:m] - C X, dB = (L dH0)[:, :r], dD = dh_0, X = L dH0 R: for block Hankel dH the
    adjoints are convolutions of the rows of L with the columns of R over time.
    """
    A, _, C, D = point
    to_a, to_b, to_c, to_d = slopes
    outputs, inputs = D.shape
    assert realization.observability is not None
    assert realization.controllability is not None
    left = jnp.linalg.pinv(realization.observability).T.reshape(-1, outputs, len(A))
    right = jnp.linalg.pinv(realization.controllability).reshape(-1, inputs, len(A))
    rows, columns = realization.row_steps, realization.column_steps
    length = fast_length(samples)
    left_f, right_f = (
        jnp.fft.rfft(_in_time(x, steps, length)) for x, steps in ((left, rows), (right, columns))
    )
    later = jnp.exp(-2j * jnp.pi * jnp.arange(left_f.shape[-1]) / length)
    # of L dH0 R, and of the same one sample later
    here = -jnp.einsum("ji,pjk->pik", A, to_a) - jnp.einsum("oi,pok->pik", C, to_c)

    def onto(x: Array) -> Array:
        """Real matrices times real and imaginary parts by turns: products without complex arithmetic."""
        return jax.lax.complex(*(jnp.einsum("pab,cbf->pacf", x, y) for y in (right_f.real, right_f.imag)))

    inner = onto(here) + onto(to_a) * later + to_b[..., None]
    product = (left_f[:, :, None] * inner[:, None]).sum(axis=2) + onto(to_c)
    total = jnp.fft.irfft(product * later, length)[..., :samples]
    return jnp.moveaxis(total, -1, 1).at[:, 0].add(to_d)


def _in_time(blocks: Array, steps: Steps, length: int) -> Float[Array, "channels n length"]:
    """Blocks put at their time indices, zero between; time last."""
    spread = jnp.zeros((*blocks.shape[1:], length), blocks.dtype)
    return spread.at[..., jnp.array(steps)].set(jnp.moveaxis(blocks, 0, -1))


def _real_row(value: Any) -> Array:
    """All numbers in a row, complex ones as real and imaginary part."""
    return ravel_pytree(jax.tree.map(_parts, value))[0]


def _parts(x: Array) -> Array:
    return jnp.stack([x.real, x.imag], axis=-1) if jnp.iscomplexobj(x) else jnp.asarray(x)


def _result(value: Any, covariance: Array) -> Propagated:
    spread = jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))
    _, unravel = ravel_pytree(jax.tree.map(_parts, value))
    deviation = jax.tree.map(
        lambda d, v: d[..., 0] + 1j * d[..., 1] if jnp.iscomplexobj(v) else d, unravel(spread), value
    )
    return Propagated(value, deviation, covariance)
