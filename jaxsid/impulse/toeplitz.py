"""The block-Toeplitz operator of convolution with measured inputs: never formed, applied and inverted by FFT.

For each record y_t = sum_k h_k u_(t-k), the record starting at rest: y = T(u) h, T lower triangular and
Toeplitz.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


def fft_length(n: int) -> int:
    """A length with small factors, at least n, at which an FFT is fast."""
    best = 1 << max(n - 1, 1).bit_length()
    return min(
        [m for f in (5, 9, 15) for m in [f * max(best // 16, 1), f * max(best // 8, 1)] if m >= n] + [best]
    )


def spectrum(u: Float[Array, "records samples inputs"], length: int) -> Complex[Array, "records f inputs"]:
    return jnp.fft.rfft(u, length, axis=1)


def convolve(
    spec: Complex[Array, "records f inputs"],
    h: Float[Array, "taps inputs"],
    mask: Float[Array, "records samples"],
    length: int,
) -> Float[Array, "records samples"]:
    """T(u) h for one output; `length` is at least taps + samples - 1."""
    product = jnp.einsum("efr,fr->ef", spec, jnp.fft.rfft(h, length, axis=0))
    return jnp.fft.irfft(product, length, axis=1)[:, : mask.shape[1]] * mask


def simulate(
    u: Float[Array, "records samples inputs"], h: Float[Array, "taps outputs inputs"]
) -> Float[Array, "records samples outputs"]:
    """The response from rest, y_t = sum_k h_k u_(t-k)."""
    s = u.shape[1]
    h = h[:s]
    length = fft_length(s + h.shape[0])
    product = jnp.einsum("efr,fmr->efm", spectrum(u, length), jnp.fft.rfft(h, length, axis=0))
    return jnp.fft.irfft(product, length, axis=1)[:, :s]


def starts(u: Float[Array, "records samples inputs"]) -> Array:
    """The instant at which each record's excitation begins, (records,)."""
    size = jnp.abs(u).max(axis=2)
    return jnp.argmax(size > 1e-12 * size.max(axis=1, keepdims=True), axis=1)


def _product(a: Array, b: Array, length: int) -> Array:
    """Product of two series of matrices, (n, i, j) and (n, j, k), cut to their length."""
    f = jnp.einsum("fij,fjk->fik", jnp.fft.rfft(a, length, axis=0), jnp.fft.rfft(b, length, axis=0))
    return jnp.fft.irfft(f, length, axis=0)[: a.shape[0]]


def series_inverse(u: Float[Array, "n r r"]) -> Float[Array, "n r r"]:
    """The causal inverse g of a series of square matrices, sum_j g_j u_(k-j) = I at k = 0, else 0.

    Newton's iteration g <- g (2 - u g) doubles the number of right terms each time. u_0 must be regular. The
    result grows without bound where u is not minimum phase: look at its size before using it.
    Source: D. Bini and V. Pan, Polynomial and Matrix Computations, section 1.9.
    """
    n, r, _ = u.shape
    length = fft_length(2 * n)
    one = jnp.zeros_like(u).at[0].set(jnp.eye(r))

    def step(i, g):
        known = (jnp.arange(n) < 2 ** (i + 1))[:, None, None]
        gap = one - _product(u, g, length)
        return jnp.where(known, g + _product(g, jnp.where(known, gap, 0), length), 0)

    first = jnp.zeros_like(u).at[0].set(jnp.linalg.inv(u[0]))
    return jax.lax.fori_loop(0, max(n - 1, 1).bit_length(), step, first)


def substitute(
    u: Float[Array, "records samples inputs"], y: Float[Array, "records samples outputs"]
) -> tuple[Float[Array, "samples outputs inputs"], Float[Array, ""]]:
    """Solve T(u) h = y exactly where there are as many records as inputs; also how far it amplifies noise.

    Each record is shifted to its first excited sample (a chirp starts at 0, so that T is singular by that one
    row); taps that no equation sees are zero. Each round of refinement removes what rounding left.
    """
    s = u.shape[1]
    late = starts(u)
    u = jax.vmap(_advance)(u, late).swapaxes(0, 1)  # (samples, records, inputs)
    y = jax.vmap(_advance)(y, late).swapaxes(0, 1)
    g = series_inverse(u)
    length = fft_length(2 * s)
    seen = (jnp.arange(s) < s - late.max())[:, None, None]
    h = jnp.zeros((s, u.shape[2], y.shape[2]), y.dtype)
    for _ in range(3):
        gap = jnp.where(seen, y - _product(u, h, length), 0)
        h = h + jnp.where(seen, _product(g, gap, length), 0)
    return h.swapaxes(1, 2), jnp.sqrt(jnp.sum(jnp.where(seen, g, 0) ** 2))


def _advance(x: Array, shift: Array) -> Array:
    """Drop the first `shift` rows, zeros at the end."""
    rolled = jnp.roll(x, -shift, axis=0)
    return jnp.where((jnp.arange(x.shape[0]) < x.shape[0] - shift)[:, None], rolled, 0)
