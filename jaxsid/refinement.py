"""What `refine` finds: one immutable value."""

import equinox as eqx
from jaxtyping import Array, Float

from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import ElementValues
from jaxsid.physical.profile import Profile
from jaxsid.records import Residuals


class Validation(eqx.Module):
    """How well models predict data that they were not fitted to.

    Attributes:
        start, refined: (outputs,) rms(y - yhat) / rms(y) of the model at the start and of the refined one.
        data: which data were held out, in words.
    """

    start: Float[Array, " outputs"]
    refined: Float[Array, " outputs"]
    data: str = eqx.field(static=True)

    @property
    def better(self) -> bool:
        """Whether the refined model predicts better, over all outputs together."""
        return bool((self.refined**2).mean() < (self.start**2).mean())


class Refinement(eqx.Module):
    """A model whose numbers were fitted to measurements.

    Attributes:
        nominal: the model that the user gave.
        model: the refined one.
        elements: its values, their standard deviations and correlation.
        covariance: (e, e) of the values, SI units; rows of what is not determined are NaN.
        data_share: (e,) part of what is known of each value that comes from the data, the rest from its prior; 1
            without prior, NaN where fixed.
        misfit: mean square of the weighted residual; 1 when the model explains all but noise. Where the noise was
            estimated from what a fit left, as by simulation in time, it is near 1 whatever the model lacks: look at
            `residuals` and `validation` then.
        outputs: names of the outputs below.
        before, after: (outputs,) rms(y - yhat) / rms(y) of the nominal and the refined model over all data.
        validation: on data that were held out, None without.
        residuals: of records, None otherwise.
        profiles: profile likelihoods that were asked for.
        at_bound: names of the values that a bound holds.
        open_combinations: combinations of values of which neither data nor priors tell, in words.
        converged: whether the solver met its tolerance.
        warnings: what the user should know.
    """

    nominal: LumpedModel
    model: LumpedModel
    elements: ElementValues
    covariance: Float[Array, "e e"]
    data_share: Float[Array, " e"]
    misfit: Float[Array, ""]
    outputs: tuple[str, ...] = eqx.field(static=True)
    before: Float[Array, " outputs"]
    after: Float[Array, " outputs"]
    validation: Validation | None
    residuals: Residuals | None
    profiles: tuple[Profile, ...]
    at_bound: tuple[str, ...] = eqx.field(static=True)
    open_combinations: tuple[str, ...] = eqx.field(static=True)
    converged: Array
    warnings: tuple[str, ...] = eqx.field(static=True)

    def value(self, name: str) -> Float[Array, ""]:
        """One value, such as "gearbox.stiffness", SI units.

        Args:
            name: of the element and its quantity.
        """
        return self.elements.values[self._index(name)]

    def deviation(self, name: str) -> Float[Array, ""]:
        """Its standard deviation.

        Args:
            name: of the element and its quantity.
        """
        return self.elements.deviation[self._index(name)]

    def _index(self, name: str) -> int:
        names = [x.name for x in self.elements.listed]
        if name not in names:
            raise KeyError(f"'{name}' is no value of the model; choose from {', '.join(names)}")
        return names.index(name)
