"""Profile likelihood: how much worse the best fit becomes when one unknown is held elsewhere.

    rise(v) = min over the others of -2 log posterior, with the unknown at v, less the least of all

Where errors are normal and small it is ((v - value) / deviation)^2; where it is not, intervals from it remain right.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.interpolate import PchipInterpolator

from jaxsid.checks import InputError
from jaxsid.physical.bounded import BoundedFit, within_bounds
from jaxsid.physical.posterior import Data
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
        fit: the best one. Bounds and positive matrices hold at every other point as they do there.
        covariance: of the unknowns, for first steps.
        misfit: mean square residual, which the rise is divided by where it is above 1.
        which: number of the unknown.

    Source: S. A. Murphy and A. W. van der Vaart, J. Am. Stat. Assoc. 95 (2000).
    """
    best, scale = np.asarray(fit.posterior.theta), np.asarray(known.unknowns.scale)
    mark = np.arange(len(best)) == which
    ends = (known.lower / scale)[which], (known.upper / scale)[which]
    least = _squares(known, fit, best)
    told = np.isfinite(covariance[which, which]) and covariance[which, which] > 0 and not fit.at_bound[which]
    usual = float(np.sqrt(covariance[which, which])) if told else UNTOLD
    along = covariance[:, which] / covariance[which, which] if told else np.zeros(len(best))
    along = np.where(mark, 1.0, along)

    def side(sign: float) -> tuple[np.ndarray, np.ndarray]:
        for reach in REACHES:
            steps = sign * reach * usual * np.linspace(0, 1, POINTS + 1)[1:]
            values = np.clip(best[which] + steps, *ends)
            values = values[np.concatenate([[True], np.diff(values) != 0]) & (values != best[which])]
            if not values.size:
                break
            squares, at = np.full(len(values), np.inf), best
            for i, value in enumerate(values):
                squares[i], at = _held(terms, known, mark, at + (value - at[which]) * along)
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


def _held(
    terms: tuple[Data, ...], known: Restricted, mark: Bool[np.ndarray, " p"], start: np.ndarray
) -> tuple[float, np.ndarray]:
    """-2 log posterior with the marked unknown held where the start has it, the others fitted from there; the fit."""
    others = known._replace(
        unknowns=known.unknowns.held(mark, start * np.asarray(known.unknowns.scale)),
        prior=Prior(known.prior.mean, np.where(mark, 0.0, np.asarray(known.prior.weight))),
        lower=np.where(mark, -np.inf, known.lower),
        upper=np.where(mark, np.inf, known.upper),
    )
    try:
        fit = within_bounds(terms, others, as_array(start))
    except InputError:  # no positive matrix has this value
        return np.inf, start
    found = np.where(mark, start, np.asarray(fit.posterior.theta))
    squares = _squares(known, fit, found)
    return squares, found if np.isfinite(squares) else start


def _squares(known: Restricted, fit: BoundedFit, at: np.ndarray) -> float:
    """-2 log posterior of a fit, with the prior of all unknowns."""
    rows, _ = known.prior.rows(as_array(at))
    return float(fit.posterior.squares + rows @ rows)


def _crossing(best: float, values: np.ndarray, rise: np.ndarray, end: float) -> float:
    """Where the rise first comes to the limit, along its root, which is nearly straight; else the end.

    Values that no fit has lie outside.
    """
    root = np.sqrt(np.maximum(np.concatenate([[0.0], rise]), 0.0))
    beyond = np.flatnonzero(root >= np.sqrt(LIMIT))
    if not beyond.size:
        return end
    if not np.isfinite(root[beyond[0]]):
        return float(values[beyond[0] - 1])
    until = beyond[0] + 1
    rising = root[:until] > np.concatenate([[-1.0], np.maximum.accumulate(root[: until - 1])])
    at = np.concatenate([[best], values])[:until][rising]
    return float(PchipInterpolator(root[:until][rising], at)(np.sqrt(LIMIT)))
