"""Choosing an estimator and its settings by how well it predicts samples that it has not seen."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.impulse.direct import Direct
from jaxsid.impulse.fourier import Fourier
from jaxsid.impulse.inband import InBand
from jaxsid.impulse.laguerre import time_samples
from jaxsid.impulse.lines import record_lines
from jaxsid.impulse.protocol import ImpulseMethod, as_records, stack
from jaxsid.impulse.toeplitz import simulate
from jaxsid.impulse.wavelet import Wavelet
from jaxsid.records import Record

CANDIDATES: tuple[ImpulseMethod, ...] = (InBand(), Direct(), Wavelet(), Wavelet(keep=64), Fourier())
MOST_LAGUERRE = 4000
# Scores this close (relative) count as equal; the earlier candidate is then kept.
TIE = 1.02


class Selection(eqx.Module):
    """The estimator chosen, and why.

    Attributes:
        method: the estimator.
        scores: one a candidate: rms of the held-out error over the rms of the held-out output, worst output.
        reason: in words.
    """

    method: ImpulseMethod
    scores: Float[Array, " candidates"]
    reason: str = eqx.field(static=True)


def select_method(
    records: Record | Sequence[Record],
    candidates: Sequence[ImpulseMethod] | None = None,
    *,
    held_out: float = 0.25,
) -> Selection:
    """The candidate that, fitted to the first part of each record, best predicts the last part.

    The prediction is the response to the whole input history, y_t = sum_k h_k u_(t-k), taps beyond the fitted part
    being zero. Needs values: it does not work under `jit`.

    Args:
        records: a Record or several of the same channels and rate.
        candidates: estimators; None tries the observer in the excited band (not with hold "band"), the time domain,
            wavelets with all and with few coefficients, Fourier.
        held_out: share of each record that is kept from the fit, 0 to 1.

    Raises InputError where the records or the share cannot be used, or no candidate suits the records.
    """
    many = as_records(records)
    tried = _usual(many) if candidates is None else tuple(candidates)
    require(len(tried) > 0, "select_method: no candidates were given.")
    require(0 < held_out < 1, f"held_out must be between 0 and 1, not {held_out}.")
    cuts = tuple(int(r.u.shape[0] * (1 - held_out)) for r in many)
    require(min(cuts) >= 8, "the records are too short to hold samples out; choose the method yourself.")
    first = [_head(r, cut) for r, cut in zip(many, cuts, strict=True)]
    # One length for all candidates, so that the simulation compiles once.
    responses = [time_samples(method(first, _samples(method, first)), max(cuts)) for method in tried]
    ensemble = stack(many)
    unseen = jnp.stack([jnp.arange(ensemble.u.shape[1]) >= cut for cut in cuts]) * ensemble.mask
    scores = np.array([float(_score(ensemble.u, ensemble.y, unseen, h)) for h in responses])
    scores = np.where(np.isfinite(scores), scores, np.inf)
    chosen = int(np.argmax(scores <= TIE * scores.min()))
    return Selection(
        method=tried[chosen], scores=jnp.asarray(scores), reason=_reason(tried, scores, chosen, held_out)
    )


def _head(record: Record, cut: int) -> Record:
    return eqx.tree_at(lambda r: (r.u, r.y), record, (record.u[:cut], record.y[:cut]))


def _samples(method: ImpulseMethod, records: Sequence[Record]) -> int | None:
    """None for the method's own choice; in the Laguerre shift as many as delay by the longest record."""
    if not isinstance(method, InBand):
        return None
    pole = float(record_lines(records, band=method.band).pole)
    return max(200, min(MOST_LAGUERRE, int(max(r.u.shape[0] for r in records) * (1 - pole) / (1 + pole))))


def _usual(records: Sequence[Record]) -> tuple[ImpulseMethod, ...]:
    """Without the one whose response has no time samples with hold "band"."""
    band = any("band" in r.hold for r in records)
    return tuple(c for c in CANDIDATES if not (band and isinstance(c, InBand)))


@compiled
def _score(u: Array, y: Array, unseen: Array, h: Array) -> Array:
    gap = jnp.sum(unseen[..., None] * (simulate(u, h) - y) ** 2, axis=(0, 1))
    size = jnp.sum(unseen[..., None] * y**2, axis=(0, 1))
    return jnp.sqrt(jnp.max(gap / jnp.where(size > 0, size, 1)))


def _reason(tried: Sequence[ImpulseMethod], scores: np.ndarray, chosen: int, held_out: float) -> str:
    words = [f"{method} {score:.3g}" for method, score in zip(tried, scores, strict=True)]
    others = ", ".join(words[:chosen] + words[chosen + 1 :])
    head = f"{tried[chosen]} predicts the held-out last {held_out:.0%} to {scores[chosen]:.3g} of its rms"
    return f"{head}; the others: {others}." if others else f"{head}; it was the only candidate."
