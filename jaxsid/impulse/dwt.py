"""The orthonormal discrete wavelet transform with periodic extension, any depth, along the first axis.

Mallat's pyramid: a_(j+1)[k] = sum_i g[i] a_j[2k + i + shift], d_(j+1)[k] = sum_i f[i] a_j[2k + i + shift], indices
modulo the length, g and f the scaling and wavelet filters. It agrees with PyWavelets' mode "periodization". S.
Mallat, A Wavelet Tour of Signal Processing, chapter 7; the filters are those of PyWavelets.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pywt
from jaxtyping import Array, Float

from jaxsid.checks import require


@lru_cache
def filters(wavelet: str) -> np.ndarray:
    """Scaling and wavelet filters of an orthogonal wavelet, (2, taps); InputError where there are none."""
    # PyWavelets re-exports these names in a way that the type checker does not see.
    known = pywt.wavelist(kind="discrete")  # pyright: ignore[reportAttributeAccessIssue]
    make = pywt.Wavelet  # pyright: ignore[reportAttributeAccessIssue]
    require(
        wavelet in known and make(wavelet).orthogonal,
        f"'{wavelet}' is no orthogonal wavelet of PyWavelets; choose haar, db1 to db38, sym2 to sym20 "
        "or coif1 to coif17.",
    )
    w = make(wavelet)
    bank = np.stack([w.dec_lo[::-1], w.dec_hi[::-1]])
    gap = np.abs(bank @ bank.T - np.eye(2)).max()
    require(
        gap < 1e-6,
        f"the filters of '{wavelet}' are orthonormal to {gap:.0e} only; use a db, sym or coif wavelet.",
    )
    return bank


def depth(length: int, level: int | None) -> int:
    """The depth asked for, or the deepest possible one; InputError where the length does not allow it."""
    deepest = (length & -length).bit_length() - 1
    level = deepest if level is None else level
    require(
        0 <= level <= deepest,
        f"A periodized transform of {length} samples has at most {deepest} levels, not {level}.",
    )
    return level


def dwt(x: Float[Array, "n ..."], *, wavelet: str, level: int | None = None) -> Float[Array, "n ..."]:
    """Orthonormal transform of the first axis, coarsest coefficients first: [a_J, d_J, ..., d_1]."""
    bank = jnp.asarray(filters(wavelet), x.dtype)
    details = []
    for _ in range(depth(x.shape[0], level)):
        x, detail = _split(x, bank)
        details.append(detail)
    return jnp.concatenate([x, *details[::-1]])


def idwt(c: Float[Array, "n ..."], *, wavelet: str, level: int | None = None) -> Float[Array, "n ..."]:
    """The inverse of `dwt`, which is its transpose."""
    bank = jnp.asarray(filters(wavelet), c.dtype)
    n = c.shape[0]
    levels = depth(n, level)
    x = c[: n >> levels]
    for j in range(levels, 0, -1):
        half = jax.ShapeDtypeStruct((n >> (j - 1), *c.shape[1:]), c.dtype)
        (x,) = jax.linear_transpose(lambda a: _split(a, bank), half)((x, c[n >> j : n >> (j - 1)]))
    return x


def _split(x: Array, bank: Array) -> tuple[Array, Array]:
    """One level: low and high half band, each half as long."""
    n, taps = x.shape[0], bank.shape[1]
    index = (2 * np.arange(n // 2)[:, None] + np.arange(taps) - taps // 2 + 1) % n
    low, high = jnp.tensordot(bank, x[index], axes=(1, 1))
    return low, high


def levels_of(length: int, level: int) -> np.ndarray:
    """For each coefficient its level: `level` for the coarsest (approximation and detail), 1 for the
    finest."""
    sizes = [length >> level] + [length >> j for j in range(level, 0, -1)]
    return np.repeat([level, *range(level, 0, -1)], sizes)
