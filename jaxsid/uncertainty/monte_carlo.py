"""Monte Carlo of any estimator over noise on an impulse response."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require, require_finite
from jaxsid.records import ImpulseResponse, Values, as_array
from jaxsid.uncertainty.ensemble import ensemble


class MonteCarlo(eqx.Module):
    """Estimates from an impulse response under many realizations of noise.

    Attributes:
        samples: what the estimator returned, as numpy arrays with a leading axis of realizations.
        mean: over the realizations that are finite throughout.
        std: standard deviation over these; for complex numbers that of the real part + 1j times the imaginary part's.
        failed: number of realizations that are not finite.
    """

    samples: Any
    mean: Any
    std: Any
    failed: int


def monte_carlo(
    estimator: Callable[[ImpulseResponse], Any],
    ir: ImpulseResponse,
    *,
    noise_std: Values,
    num_samples: int,
    key: Array,
    chunk: int = 1024,
    progress: Callable[[int], None] | None = None,
) -> MonteCarlo:
    """Estimates from h + noise_std * e, with e independent and normal, for `num_samples` realizations of e.

    Args:
        estimator: of an impulse response, to a pytree of arrays; traced, so any composition of this library's
            functions, such as `lambda ir: jaxsid.modal(jaxsid.era(ir, order=6, rows=40, cols=40)).frequencies`.
        ir: impulse response to add noise to.
        noise_std: standard deviation of the noise, one number, one for each output, or of the shape of `ir.h`.
        num_samples: realizations.
        key: of chance; realization i does not depend on `num_samples` or `chunk`.
        chunk: realizations in memory on the device at a time.
        progress: called with the number of realizations done.

    Raises:
        InputError: negative noise or another shape, fewer than two realizations.
    """
    require(num_samples >= 2, f"num_samples must be at least 2, not {num_samples}.")
    size = as_array(noise_std)
    require(
        size.shape in ((), ir.h.shape[1:2], ir.h.shape),
        f"noise_std must be one number, one for each of the {ir.h.shape[1]} outputs, or of the shape of the impulse "
        f"response {ir.h.shape}, not {size.shape}.",
    )
    require_finite(size, "noise_std")
    require(bool((size >= 0).all()), "noise_std must not be negative.")
    size = size[:, None] if size.ndim == 1 else size
    drawn = ensemble(
        _Draw(estimator, ir, size.astype(ir.h.dtype)), key, num_samples, chunk=chunk, progress=progress
    )
    finite = np.ones(num_samples, bool)
    for x in jax.tree.leaves(drawn):
        finite &= np.isfinite(x).reshape(num_samples, -1).all(axis=1)
    good = jax.tree.map(lambda x: x[finite], drawn)
    mean = jax.tree.map(lambda x: np.asarray(x.mean(axis=0)), good)
    return MonteCarlo(drawn, mean, jax.tree.map(_std, good), int((~finite).sum()))


class _Draw(eqx.Module):
    """The estimate from one realization of the noise."""

    estimator: Callable[[ImpulseResponse], Any]
    ir: ImpulseResponse
    size: Float[Array, "..."]

    def __call__(self, key: Array) -> Any:
        h = self.ir.h + self.size * jax.random.normal(key, self.ir.h.shape, self.ir.h.dtype)
        return jax.tree.map(jnp.asarray, self.estimator(eqx.tree_at(lambda ir: ir.h, self.ir, h)))


def _std(x: Any) -> Any:
    if np.iscomplexobj(x):
        return _std(np.real(x)) + 1j * _std(np.imag(x))
    return np.asarray(np.std(x, axis=0, ddof=1))
