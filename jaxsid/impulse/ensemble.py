"""Ensemble averaging in the wavelet domain, in the two ways of the thesis [2.33-2.39].

products      [2.33-2.35]: average y U_DWT' and U_DWT U_DWT' over the records, then solve once.
correlations  [2.36-2.39]: average the correlations y U' and U U' themselves, then transform them along their lags
              and solve R_yu = h_DWT (W R_uu).

With every coefficient kept both are the time-domain estimate sum(y U') (sum U U')^-1, for any number of records, and
differ by rounding only; with coefficients dropped, products minimizes the output error over the subspace,
correlations the error of the correlations. Normal equations square the condition number: directions below the square
root of the rounding error are lost, which `Wavelet` and `Direct` do not lose.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.impulse.dwt import depth, filters, idwt, levels_of
from jaxsid.impulse.protocol import Ensemble, as_records, returned_samples, stack
from jaxsid.records import ImpulseResponse, Record

VARIANTS = ("products", "correlations")
# The matrix of the normal equations is dense, (taps * inputs) squared: taps are few unless asked for.
DEFAULT_TAPS = 256
MOST_UNKNOWNS = 8192


class WaveletEnsemble(eqx.Module):
    """Averaged normal equations in wavelet coordinates, records starting at rest.

    Attributes:
        variant: "products" or "correlations", see the module.
        wavelet: an orthogonal wavelet by its PyWavelets name.
        level: depth of the transform, full if None.
        taps: length of the modelled impulse response besides the feedthrough, rounded up to what the depth
            allows; it must have decayed by then. None is 256, or less for short records.
        keep: number of coarse coefficients kept, all if None.
        rank_cut: relative eigenvalue below which a direction is dropped.
        orthonormal: False scales the transform's levels as unnormalized filters do, W W' = diag(D), and
            carries the diagonal D through the solution; the estimate is the same.
    """

    variant: str = eqx.field(static=True, default="products")
    wavelet: str = eqx.field(static=True, default="db4")
    level: int | None = eqx.field(static=True, default=None)
    taps: int | None = eqx.field(static=True, default=None)
    keep: int | None = eqx.field(static=True, default=None)
    rank_cut: float = eqx.field(static=True, default=1e-12)
    orthonormal: bool = eqx.field(static=True, default=True)

    def __call__(self, records: Sequence[Record], samples: int | None = None) -> ImpulseResponse:
        """The impulse response of an ensemble; see the class."""
        ensemble = stack(as_records(records))
        require(
            self.variant in VARIANTS,
            f"variant '{self.variant}' is unknown; choose from {', '.join(VARIANTS)}.",
        )
        filters(self.wavelet)
        s, r = ensemble.u.shape[1:]
        taps = self.taps or min(DEFAULT_TAPS, 1 << max((s // (2 * r)).bit_length() - 1, 0))
        require(0 < taps <= s, f"taps must be between 1 and the record's {s} samples, not {taps}.")
        block = 1 << (self.level if self.level is not None else (taps - 1).bit_length())
        length = -(-taps // block) * block
        level = depth(length, self.level)
        require(
            length * r <= MOST_UNKNOWNS,
            f"{length} taps of {r} inputs are too many for dense normal equations; use Direct.",
        )
        keep = length if self.keep is None else self.keep
        require(1 <= keep <= length, f"keep must be between 1 and {length}, not {keep}.")
        kept = returned_samples(samples, min(length + 1, s), "the modelled response (see taps)")
        W = _transform(self.wavelet, length, level, self.orthonormal, ensemble.y.dtype)
        h, noise = _solve(ensemble, W, keep=keep, variant=self.variant, cut=self.rank_cut)
        words = (
            f"wavelet-domain ensemble average of {self.variant}, {len(ensemble.lengths)} records, "
            f"{self.wavelet}, "
            f"{level} levels, {keep} of {length} coefficients, feedthrough apart"
        )
        return ImpulseResponse(h[:kept], ensemble.dt, noise_std=noise, hold=ensemble.hold, method=words)


def _transform(
    wavelet: str, length: int, level: int, orthonormal: bool, dtype: jnp.dtype
) -> Float[Array, "n n"]:
    """W with rows scaled by level unless orthonormal; the first row and column are the feedthrough's."""
    W = idwt(jnp.eye(length, dtype=dtype), wavelet=wavelet, level=level).T
    if not orthonormal:
        W = W * 2.0 ** (jnp.asarray(levels_of(length, level), dtype) / 2)[:, None]
    return jnp.zeros((length + 1, length + 1), dtype).at[0, 0].set(1).at[1:, 1:].set(W)


@compiled
def _solve(ensemble: Ensemble, W: Array, *, keep: int, variant: str, cut: float) -> tuple[Array, Array]:
    n, r, m = W.shape[0], ensemble.u.shape[2], ensemble.y.shape[2]
    D = jnp.sum(W**2, axis=1)
    # With W W' = D, h_DWT = h W' D^-1 and U_DWT = W U: y = h U = h_DWT U_DWT, h = h_DWT W.
    Wq = jnp.kron(W[: keep + 1] / D[: keep + 1, None], jnp.eye(r, dtype=W.dtype))
    Dq = jnp.repeat(D[: keep + 1], r)[:, None]

    def average(record):
        u, y, mask = record
        U = lagged(u, n).T * mask  # (n inputs, samples)
        if variant == "products":
            U = Dq * (Wq @ U)
        return y.T @ U.T, U @ U.T, jnp.sum(mask * y.T**2, axis=1)

    yu, uu, yy = (x.sum(axis=0) for x in jax.lax.map(average, (ensemble.u, ensemble.y, ensemble.mask)))
    if variant == "products":
        c = yu @ jnp.linalg.pinv(uu, rtol=cut, hermitian=True)
    else:
        c = yu @ jnp.linalg.pinv(Dq * (Wq @ uu), rtol=cut)
    h = c @ (Dq * Wq)
    if variant == "products":
        misfit = yy - 2 * jnp.sum(c * yu, axis=1) + jnp.einsum("mi,ij,mj->m", c, uu, c)
    else:
        misfit = yy - 2 * jnp.sum(h * yu, axis=1) + jnp.einsum("mi,ij,mj->m", h, uu, h)
    spare = jnp.maximum(ensemble.mask.sum() - (keep + 1) * r, 1)
    return h.reshape(m, n, r).swapaxes(0, 1), jnp.sqrt(jnp.maximum(misfit, 0) / spare)


def lagged(u: Float[Array, "samples inputs"], n: int) -> Float[Array, "samples columns"]:
    """U': row t holds u_t, u_(t-1), ..., u_(t-n+1), zero before the record; columns (lag, input)."""
    s, r = u.shape
    back = jnp.pad(u, ((n - 1, 0), (0, 0)))
    index = jnp.arange(s)[:, None] + (n - 1) - jnp.arange(n)
    return back[index].reshape(s, n * r)
