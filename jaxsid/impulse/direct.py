"""Impulse response in the time domain: block-Toeplitz least squares, exact where the data allow it, else
regularized.

y_t = sum_k h_k u_(t-k), all inputs at once. Two structured solvers, both O(s log s) a step and without a
matrix:

- exact: series inversion of the input, where there are as many records as inputs and the inversion amplifies
the
  noise seen in the record so little that the answer is good;
- regularized: Bayesian estimate with a prior that says how smooth an impulse response is and how it decays,
the
  DC kernel and its second-order kin (T. Chen, H. Ohlsson, L. Ljung, Automatica 48 (2012) 1525-1535), solved in a
  Krylov space. The feedthrough is free: an accelerometer's is a spike that no smooth prior would allow.
"""

from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsid.checks import is_concrete, require
from jaxsid.compilation import compiled
from jaxsid.impulse.krylov import solve, trace_quadrature
from jaxsid.impulse.noise import noise_level
from jaxsid.impulse.protocol import Ensemble, as_records, returned_samples, stack
from jaxsid.impulse.toeplitz import convolve, fft_length, simulate, spectrum, substitute
from jaxsid.records import ImpulseResponse, Record

# (order of smoothness, correlation length in samples, decay time as a share of the taps) of the priors that
# are
# tried, the likeliest is kept.
PRIORS = (
    *((2.0, length, decay) for length in (3.0, 10.0, 30.0, 100.0) for decay in (0.1, 0.3)),
    (2.0, 300.0, 1e6),
    (1.0, 1000.0, 1e6),
)
# The exact solution is taken where noise makes up less than this share of it.
EXACT_ENOUGH = 1e-3

Prior = Callable[[Array, Array], Array]


class Direct(eqx.Module):
    """Least squares y = h * u in the time domain, records starting at rest.

    Attributes:
        solver: "exact" (series inversion: as many records as inputs), "regularized", or "auto" (by the noise
        seen).
        ridge: regularization relative to the largest squared singular value; None chooses it by likelihood.
        taps: length of the modelled impulse response, the whole record if None. Fewer taps leave out the
            effect of older input, which is an error unless the response has decayed by then.
        skip: leave the first samples of each record out of the fit.
        history: "rest" (nothing moved before the record) or "unknown" (equations that reach back are left
        out;
            the taps are then half the record unless told).
        steps: dimension of the Krylov space.
    """

    solver: str = eqx.field(static=True, default="auto")
    ridge: float | None = eqx.field(static=True, default=None)
    taps: int | None = eqx.field(static=True, default=None)
    skip: int = eqx.field(static=True, default=0)
    history: str = eqx.field(static=True, default="rest")
    steps: int = eqx.field(static=True, default=60)

    def __call__(self, records: Sequence[Record], samples: int | None = None) -> ImpulseResponse:
        """The impulse response of one record or an ensemble; see the class."""
        ensemble = stack(as_records(records))
        s, r = ensemble.u.shape[1:]
        skip, taps = self._window(s, r)
        square = skip == 0 and taps == s and ensemble.u.shape[0] == r and len(set(ensemble.lengths)) == 1
        require(self.solver in ("auto", "exact", "regularized"), f"solver '{self.solver}' is unknown.")
        require(
            self.solver != "exact" or square,
            f"the exact solver needs as many records as inputs ({r}), of one length, whole and from rest; "
            "use solver='regularized'.",
        )
        kept = returned_samples(samples, taps, "the record (with the taps asked for)")
        solver = "regularized" if not square else self.solver
        steps = min(self.steps, ensemble.mask.size, taps * r)
        h, noise, exact = _estimate(
            ensemble, taps=taps, skip=skip, solver=solver, steps=steps, ridge=self.ridge
        )
        return ImpulseResponse(
            h[:kept], ensemble.dt, noise_std=noise, hold=ensemble.hold, method=self._words(exact, taps)
        )

    def _window(self, s: int, r: int) -> tuple[int, int]:
        """Samples to leave out at the start, and number of taps."""
        require(self.history in ("rest", "unknown"), f"history '{self.history}' is unknown.")
        taps = self.taps or (s if self.history == "rest" else s // (1 + r))
        require(0 < taps <= s, f"taps must be between 1 and the record's {s} samples, not {taps}.")
        skip = max(self.skip, taps - 1 if self.history == "unknown" else 0)
        require(0 <= skip < s, f"leaving out {skip} of {s} samples leaves nothing to fit; use fewer taps.")
        return skip, taps

    def _words(self, exact: Array, taps: int) -> str:
        settings = f"{taps} taps, history {self.history}"
        if not is_concrete(exact):
            return f"direct time-domain least squares, {settings}"
        if bool(np.all(exact)):
            return f"direct time-domain least squares, exact by series inversion, {settings}"
        strength = "by likelihood" if self.ridge is None else f"{self.ridge:g}"
        return f"direct time-domain least squares, smooth decaying prior, strength {strength}, {settings}"


def smooth_prior(theta: Array, z: Float[Array, "taps inputs"]) -> Float[Array, "taps inputs"]:
    """z, white, to a response that is free at 0, then smooth, and decays.

    For k > 0: h_k = exp(-k / decay) sum_(j >= k) f_(j-k) z_j, f_i = exp(-i / length) for order 1 (the DC kernel), (1
    + i) exp(-i / length) for order 2. The filter runs backwards, so that the first taps have full size.
    """
    order, correlation, decay = theta
    m = z.shape[0] - 1
    if m == 0:
        return z
    k = jnp.arange(m, dtype=z.dtype)
    kernel = jnp.exp(-k / correlation) * jnp.where(order > 1.5, 1 + k, 1)
    kernel = kernel / jnp.linalg.norm(kernel)
    length = fft_length(2 * m)
    spec = jnp.fft.rfft(kernel, length)[:, None] * jnp.fft.rfft(z[:0:-1], length, axis=0)
    smooth = jnp.fft.irfft(spec, length, axis=0)[:m][::-1]
    return jnp.concatenate([z[:1], smooth * jnp.exp(-k / (decay * m))[:, None]])


@compiled
def _estimate(
    ensemble: Ensemble, *, taps: int, skip: int, solver: str, steps: int, ridge: float | None
) -> tuple[Array, Array, Bool[Array, ""]]:
    """h (taps, outputs, inputs), the noise on each output, and whether the exact solution was taken."""
    noise = noise_level(ensemble.u, ensemble.y, ensemble.mask)

    def regularized():
        priors = jnp.asarray(PRIORS, ensemble.y.dtype)
        return bayesian(ensemble, noise, smooth_prior, priors, taps=taps, skip=skip, steps=steps, ridge=ridge)

    if solver == "regularized":
        h, noise = regularized()
        return h, noise, jnp.asarray(False)
    h, amplification = substitute(ensemble.u, ensemble.y)
    if solver == "exact":
        return h, noise, jnp.asarray(True)
    good = good_enough(ensemble, h, noise * amplification)
    h, noise = jax.lax.cond(good, lambda: (h, noise), regularized)
    return h, noise, good


def good_enough(
    ensemble: Ensemble, h: Float[Array, "taps outputs inputs"], error: Float[Array, " outputs"]
) -> Bool[Array, ""]:
    """Whether an exact solution reproduces the records and the noise in it, `error`, is a small share of
    it."""
    size = jnp.sqrt(jnp.sum(h[1:] ** 2, axis=(0, 2)))
    # Where rounding has blown up, the solution does not reproduce the record. False for NaN too.
    gap = jnp.abs(simulate(ensemble.u, h) - ensemble.y).max()
    true = gap < jnp.finfo(h.dtype).eps ** 0.5 * jnp.abs(ensemble.y).max()
    return true & jnp.all(error < EXACT_ENOUGH * size)


def bayesian(
    ensemble: Ensemble,
    noise: Float[Array, " outputs"],
    prior: Prior,
    thetas: Float[Array, "candidates ..."],
    *,
    taps: int,
    skip: int,
    steps: int,
    ridge: float | None,
) -> tuple[Float[Array, "taps outputs inputs"], Float[Array, " outputs"]]:
    """The regularized estimate under the likeliest of the candidate priors, output by output, and the noise
    left."""
    s, r = ensemble.u.shape[1:]
    mask = ensemble.mask * (jnp.arange(s) >= skip)
    rms = jnp.sqrt(jnp.sum(ensemble.u**2, axis=(0, 1)) / ensemble.mask.sum())
    u = ensemble.u / rms
    length = fft_length(s + taps)
    spec = spectrum(u, length)
    weights = _feedthrough_weights(spec, prior, thetas, mask, (taps, r), length)

    def response(theta, weight, z):
        return prior(theta, z.reshape(taps, r).at[0].multiply(weight))

    def forward(theta, weight, z):
        return convolve(spec, response(theta, weight, z), mask, length).ravel()

    blank = jnp.zeros(taps * r, ensemble.y.dtype)
    key = jax.random.key(0)  # common to all candidates, so that their comparison is fair
    traces = jax.lax.map(
        lambda a: trace_quadrature(partial(forward, *a), mask.ravel(), blank, key, steps), (thetas, weights)
    )

    def one_candidate(y, std, theta, weight, trace):
        found = solve(partial(forward, theta, weight), y.ravel(), blank, std, trace, steps, ridge)
        spare = jnp.maximum(mask.sum() - found.freedom, 1)
        return response(theta, weight, found.z), found.cost, found.misfit / spare

    def one_output(args):
        y, std = args
        h, cost, variance = jax.lax.map(lambda a: one_candidate(y, std, *a), (thetas, weights, traces))
        best = jnp.argmin(cost)
        return h[best], jnp.sqrt(variance[best])

    h, left = jax.lax.map(one_output, (jnp.moveaxis(ensemble.y * mask[..., None], 2, 0), noise))
    return jnp.moveaxis(h, 0, 1) / rms, left


def _feedthrough_weights(
    spec: Array, prior: Prior, thetas: Array, mask: Array, shape: tuple[int, int], length: int
) -> Float[Array, " candidates"]:
    """How large the feedthrough's prior must be to reach as far into the output as all the rest together."""
    probe = jax.random.normal(jax.random.key(0), shape, mask.dtype).at[0].set(0)
    spike = jnp.zeros(shape, mask.dtype).at[0].set(1)
    reach = jnp.linalg.norm(convolve(spec, spike, mask, length))
    return jax.lax.map(
        lambda theta: jnp.linalg.norm(convolve(spec, prior(theta, probe), mask, length)) / reach, thetas
    )
