"""Impulse response through its wavelet coefficients.

With U[tau, t] = u(t - tau) and W the orthonormal transform along tau, y = h U = (h W') (W U) = h_DWT U_DWT. At full
length and depth that is a change of coordinates: the least-squares solution is the time-domain one. What the basis
buys is a subspace: keep the coarse coefficients only, or expect the fine ones to be small. The feedthrough is an
unknown of its own beside the wavelet coefficients of the taps 1, 2, ..., because an accelerometer's is a spike that
no coarse subspace holds, and left out it would spoil every tap after it.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsid.checks import is_concrete, require
from jaxsid.compilation import compiled
from jaxsid.impulse.direct import bayesian, good_enough
from jaxsid.impulse.dwt import depth, filters, idwt, levels_of
from jaxsid.impulse.krylov import STRENGTHS
from jaxsid.impulse.noise import noise_level
from jaxsid.impulse.protocol import Ensemble, as_records, returned_samples, stack
from jaxsid.impulse.toeplitz import simulate, substitute
from jaxsid.records import ImpulseResponse, Record

# A coefficient of level j is expected to be of the size 2^(slope min(j, top)): levels above `top` are slower
# than
# the system. The response has the envelope exp(-k / decay), decay as a share of the record. (top, decay) of
# the
# priors that are tried, the likeliest is kept.
PRIORS = ((4.0, 0.1), (4.0, 0.3), (6.0, 0.1), (6.0, 0.3), (4.0, 1e6), (6.0, 1e6), (99.0, 1e6))


class Wavelet(eqx.Module):
    """Least squares for the wavelet coefficients of the impulse response, records starting at rest.

    The modelled length is the next length that the depth allows (a power of two for full depth); taps beyond the
    record are seen by no equation and are not returned.

    Attributes:
        wavelet: an orthogonal wavelet by its PyWavelets name; "db4" has 8 coefficients and 4 vanishing
        moments.
        level: depth of the transform, full if None.
        keep: number of coarse coefficients kept per input and output, a subspace solved densely with a rank
        cut;
            None keeps all: exact where the noise allows, else shrunk by a prior.
        slope: expected growth of the coefficients from level to level (power of two), which shrinks the
            fine ones; the strength is chosen by likelihood.
        shrink: False never shrinks: the plain least-squares solution in the subspace (needs `keep`).
        rank_cut: relative singular value below which a direction of the subspace is dropped.
        steps: dimension of the Krylov space.
    """

    wavelet: str = eqx.field(static=True, default="db4")
    level: int | None = eqx.field(static=True, default=None)
    keep: int | None = eqx.field(static=True, default=None)
    slope: float = eqx.field(static=True, default=1.5)
    shrink: bool = eqx.field(static=True, default=True)
    rank_cut: float = eqx.field(static=True, default=1e-10)
    steps: int = eqx.field(static=True, default=60)

    def __call__(self, records: Sequence[Record], samples: int | None = None) -> ImpulseResponse:
        """The impulse response of one record or an ensemble; see the class."""
        ensemble = stack(as_records(records))
        s, r = ensemble.u.shape[1:]
        length, level = self.shape(s)
        kept = returned_samples(samples, s, "the longest record")
        require(self.shrink or self.keep is not None, "shrink=False needs `keep`; use Direct for all taps.")
        if self.keep is None:
            whole = ensemble.u.shape[0] == r and len(set(ensemble.lengths)) == 1
            steps = min(self.steps, ensemble.mask.size, s * r)
            # Twice as long: the periodic seam then lies beyond the record, or the strong first taps would
            # leak through it into the weakly determined last ones.
            shape = (self.wavelet, 2 * length, level + 1 if self.level is None else level)
            h, noise, exact = _shrunk(ensemble, shape=shape, slope=self.slope, steps=steps, whole=whole)
        else:
            require(1 <= self.keep <= length, f"keep must be between 1 and {length}, not {self.keep}.")
            h, noise = _subspace(
                ensemble,
                shape=(self.wavelet, length, level),
                keep=self.keep,
                cut=self.rank_cut,
                slope=self.slope if self.shrink else None,
            )
            exact = jnp.asarray(False)
        words = self._words(exact, length, level)
        return ImpulseResponse(h[:kept], ensemble.dt, noise_std=noise, hold=ensemble.hold, method=words)

    def shape(self, samples: int) -> tuple[int, int]:
        """Length and depth of the transform of taps 1, 2, ... for records of this many samples."""
        filters(self.wavelet)
        if self.level is None:
            length = 1 << max(samples - 1, 1).bit_length()
            return length, depth(length, None)
        require(self.level >= 0, f"level must not be negative, not {self.level}.")
        block = 1 << self.level
        return -(-samples // block) * block, self.level

    def _words(self, exact: Array, length: int, level: int) -> str:
        how = f"keeping {self.keep} of {length} coefficients" if self.keep is not None else "all coefficients"
        if self.keep is None and is_concrete(exact):
            how += ", exact by series inversion" if bool(exact) else ", fine levels shrunk by likelihood"
        return f"wavelet {self.wavelet}, {level} levels, length {length}, {how}, feedthrough apart"


def basis(*, wavelet: str, length: int, level: int, keep: int) -> Float[Array, "length keep"]:
    """The responses of the coarsest `keep` coefficients, one a column."""
    return idwt(jnp.eye(length, keep), wavelet=wavelet, level=level)


@compiled
def _shrunk(
    ensemble: Ensemble, *, shape: tuple[str, int, int], slope: float, steps: int, whole: bool
) -> tuple[Array, Array, Bool[Array, ""]]:
    """All coefficients: exact where that is good enough, else under the prior."""
    wavelet, length, level = shape
    s = ensemble.u.shape[1]
    levels, lag = levels_of(length, level), np.arange(length)[:, None] / s
    noise = noise_level(ensemble.u, ensemble.y, ensemble.mask)

    def prior(theta, z):
        top, decay = theta
        size = 2.0 ** (slope * (jnp.minimum(levels, top) - level))
        taps = idwt(z[1:] * size[:, None].astype(z.dtype), wavelet=wavelet, level=level)
        taps = taps * jnp.exp(-lag / decay).astype(z.dtype)
        return jnp.concatenate([z[:1], taps])

    def regularized():
        thetas = jnp.asarray(PRIORS, ensemble.y.dtype)
        h, left = bayesian(ensemble, noise, prior, thetas, taps=length + 1, skip=0, steps=steps, ridge=None)
        return h[:s], left

    if not whole:
        return *regularized(), jnp.asarray(False)
    h, amplification = substitute(ensemble.u, ensemble.y)
    good = good_enough(ensemble, h, noise * amplification)
    h, left = jax.lax.cond(good, lambda: (h, noise), regularized)
    return h, left, good


@compiled
def _subspace(
    ensemble: Ensemble, *, shape: tuple[str, int, int], keep: int, cut: float, slope: float | None
) -> tuple[Array, Array]:
    """Dense thin least squares for [feedthrough, coarse coefficients] of every input."""
    wavelet, length, level = shape
    r, m = ensemble.u.shape[2], ensemble.y.shape[2]
    table = regressors(ensemble, basis(wavelet=wavelet, length=length, level=level, keep=keep))
    y = (ensemble.y * ensemble.mask[..., None]).reshape(-1, m)
    size = jnp.linalg.norm(table, axis=0)
    if slope is not None:
        fine = 2.0 ** (-slope * (levels_of(length, level)[:keep] - level))
        size = jnp.repeat(jnp.append(1.0, fine), r) * jnp.append(size[:r], jnp.full(keep * r, size[r:].max()))
    size = jnp.where(size > 0, size, 1).astype(y.dtype)
    Q, R = jnp.linalg.qr(table / size)
    P, sv, Vt = jnp.linalg.svd(R, full_matrices=False)
    used = sv > cut * sv[0]
    projected = P.T @ (Q.T @ y)
    spare = jnp.maximum(ensemble.mask.sum() - used.sum(), 1)
    outside = jnp.sum((y - Q @ (P @ (used[:, None] * projected))) ** 2, axis=0)
    damped = jnp.zeros((len(sv), m), y.dtype)
    if slope is not None:
        damped = jax.vmap(_damping, in_axes=(None, 1, 0), out_axes=1)(sv, projected, outside / spare)
    gain = used[:, None] * sv[:, None] / jnp.where(used[:, None], sv[:, None] ** 2 + damped, 1)
    c = ((Vt.T @ (gain * projected)) / size[:, None]).reshape(keep + 1, r, m)
    taps = idwt(jnp.pad(c[1:], ((0, length - keep), (0, 0), (0, 0))), wavelet=wavelet, level=level)
    return jnp.concatenate([c[:1], taps])[: ensemble.u.shape[1]].swapaxes(1, 2), jnp.sqrt(outside / spare)


def _damping(sv: Array, projected: Array, variance: Array) -> Array:
    """The likeliest ratio of noise to prior variance, for the noise variance that least squares leaves."""
    grid = sv[0] ** 2 * jnp.logspace(2 * jnp.log10(jnp.finfo(sv.dtype).eps), 1, STRENGTHS, dtype=sv.dtype)
    explained = jnp.sum(projected**2 * grid[:, None] / (sv**2 + grid[:, None]), axis=1)
    cost = explained / variance + jnp.sum(jnp.log1p(sv**2 / grid[:, None]), axis=1)
    return jax.lax.stop_gradient(jnp.full_like(sv, grid[jnp.argmin(cost)]))


def regressors(ensemble: Ensemble, shapes: Float[Array, "length keep"]) -> Float[Array, "rows columns"]:
    """U_DWT': the input, then its convolution with each basis response one step later; columns (coefficient,
    input)."""
    e, s, r = ensemble.u.shape
    delayed = jnp.pad(shapes, ((1, 0), (0, 0)))[:s]
    # One simulated single-input system per input; its outputs are the basis responses.
    waves = jax.vmap(lambda u: simulate(u[..., None], delayed[..., None]), in_axes=2, out_axes=3)(ensemble.u)
    table = jnp.concatenate([ensemble.u[:, :, None, :], waves], axis=2) * ensemble.mask[..., None, None]
    return table.reshape(e * s, (shapes.shape[1] + 1) * r)
