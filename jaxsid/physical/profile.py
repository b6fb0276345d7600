"""Profile likelihood: how much worse the best fit becomes when one unknown is held elsewhere.

    rise(v) = min over the others of -2 log posterior, with the unknown at v, less the least of all

Where errors are normal and small it is ((v - value) / deviation)^2; where it is not, intervals from it remain right.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import PchipInterpolator

from jaxsid.compilation import compiled
from jaxsid.physical.bounded import BoundedFit
from jaxsid.physical.elements import LinearMatrices
from jaxsid.physical.posterior import Data, most_probable
from jaxsid.physical.restrictions import Prior, Restricted
from jaxsid.records import as_array

REACHES = (4.0, 16.0, 64.0, 256.0)  # standard deviations to either side, until the rise comes to the limit
POINTS = 8  # to either side
LIMIT = 3.841458820694124  # of chi squared with one degree of freedom, 95 %
UNTOLD = 0.1  # of an unknown's scale, where nothing says how far to look


class Profile(eqx.Module):
    """Profile likelihood of one unknown.

    Attributes:
        name: of the value, or of all that are tied to it.
        values: (g,) at which it was held, SI units.
        rise: (g,) of -2 log posterior, the others fitted anew; infinite where no fit was found, negative where the
            refinement had not come to the best one.
        interval: (2,) of 95 % confidence: where the rise is 3.84, of chi squared with one degree of freedom; infinite
            where it never is, a bound where that comes first.
    """

    name: str = eqx.field(static=True)
    values: Float[Array, " g"]
    rise: Float[Array, " g"]
    interval: Float[Array, "2"]


@compiled
def _held(
    terms: tuple[Data, ...],
    unknowns: LinearMatrices,
    prior: Prior,
    which: Float[Array, " p"],
    starts: Float[Array, "g p"],
) -> Float[Array, " g"]:
    """-2 log posterior with one unknown, marked by 1, held where the starts have it."""
    mix, weight = jnp.asarray(unknowns.mix), jnp.asarray(prior.weight)
    others = Prior(prior.mean, weight * (1 - which))

    def at(start: Array) -> Array:
        base = jnp.asarray(unknowns.base) + mix @ (which * start * unknowns.scale)
        rest = eqx.tree_at(lambda x: (x.base, x.mix), unknowns, (base, mix * (1 - which)))
        found = most_probable(terms, rest, others, start)
        r, _ = prior.rows(jnp.where(which > 0, start, found.theta))
        return found.squares + r @ r

    return jax.lax.map(at, starts)


def profile(
    terms: tuple[Data, ...],
    known: Restricted,
    fit: BoundedFit,
    covariance: Float[np.ndarray, "p p"],
    misfit: float,
    which: int,
) -> Profile:
    """How the fit worsens as one unknown moves away from its best value, the others fitted anew.

    Args:
        terms: the data.
        known: bounds and priors.
        fit: the best one; what else a bound holds there stays held.
        covariance: of the unknowns, for first steps.
        misfit: mean square residual, which the rise is divided by where it is above 1.
        which: number of the unknown.

    Source: S. A. Murphy and A. W. van der Vaart, J. Am. Stat. Assoc. 95 (2000).
    """
    best, scale = np.asarray(fit.posterior.theta), np.asarray(known.unknowns.scale)
    still = fit.at_bound & (np.arange(len(best)) != which)
    unknowns = known.unknowns.held(still, best * scale)
    prior = Prior(known.prior.mean, np.where(still, 0.0, np.asarray(known.prior.weight)))
    ends = (known.lower / scale)[which], (known.upper / scale)[which]
    r, _ = prior.rows(jnp.asarray(best))
    least = float(fit.posterior.squares + r @ r)
    told = np.isfinite(covariance[which, which]) and covariance[which, which] > 0
    usual = float(np.sqrt(covariance[which, which])) if told else UNTOLD
    along = covariance[:, which] / covariance[which, which] if told else np.zeros(len(best))
    mark = np.arange(len(best)) == which
    along = np.where(mark, 1.0, along)

    def side(sign: float) -> tuple[np.ndarray, np.ndarray]:
        for reach in REACHES:
            steps = sign * reach * usual * np.linspace(0, 1, POINTS + 1)[1:]
            values = np.clip(best[which] + steps, *ends)
            values = values[np.concatenate([[True], np.diff(values) != 0]) & (values != best[which])]
            if not values.size:
                break
            starts = best + (values - best[which])[:, None] * along
            squares = np.asarray(_held(terms, unknowns, prior, jnp.asarray(1.0 * mark), jnp.asarray(starts)))
            rise = np.where(np.isfinite(squares), squares - least, np.inf) / max(misfit, 1.0)
            if rise.max() > LIMIT or values[-1] in ends:
                return values, rise
        return values, rise if values.size else values

    (down, low), (up, high) = side(-1.0), side(1.0)
    interval = _crossing(best[which], down, low, ends[0]), _crossing(best[which], up, high, ends[1])
    return Profile(
        known.names[which],
        values=as_array(scale[which] * np.concatenate([down[::-1], best[which : which + 1], up])),
        rise=as_array(np.concatenate([low[::-1], [0.0], high])),
        interval=as_array(scale[which] * np.array(interval)),
    )


def _crossing(best: float, values: np.ndarray, rise: np.ndarray, end: float) -> float:
    """Where the rise first comes to the limit, along its root, which is nearly straight; else the end."""
    root = np.sqrt(np.maximum(np.concatenate([[0.0], rise]), 0.0))
    beyond = np.flatnonzero(root >= np.sqrt(LIMIT))
    if not beyond.size or not np.isfinite(root[beyond[0]]):
        return end
    until = beyond[0] + 1
    rising = root[:until] > np.concatenate([[-1.0], np.maximum.accumulate(root[: until - 1])])
    at = np.concatenate([[best], values])[:until][rising]
    return float(PchipInterpolator(root[:until][rising], at)(np.sqrt(LIMIT)))
