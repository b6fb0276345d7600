"""How well the model that the user gave, CBSI's and the fitted one repeat the records."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Array, Float

from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.pipeline.fit import TimeFit, time_errors
from jaxsid.pipeline.matrices import Found, explained, sensed_rows, with_matrices
from jaxsid.pipeline.setting import Setting
from jaxsid.records import Record, as_array


class BeforeAfter(NamedTuple):
    """rms(y - yhat) / std(y) of each output over all records, None where there is no such model."""

    nominal: Float[Array, " outputs"]
    cbsi: Float[Array, " outputs"] | None
    matrices: Float[Array, " outputs"] | None


def before_after(
    model: LumpedModel,
    records: Sequence[Record],
    system: Setting,
    found: Found,
    times: TimeFit,
    at_rest: bool,
) -> BeforeAfter:
    """Each model from its own initial states.

    Args:
        model: nominal; effects are left out.
        records: what was measured.
        system: which sensors were measured.
        found: matrices.
        times: the comparison of the model that is reported.
        at_rest: start from rest instead.
    """
    sensed = sensed_rows(model, system)
    cbsi = fitted = None
    if found.cbsi is not None:
        matrices = found.cbsi.mass, found.cbsi.damping, found.cbsi.stiffness
        cbsi = as_array(time_errors(with_matrices(sensed, matrices), records, system.outputs, at_rest))
    if found.fit is not None and found.model is not None:
        # where they explain the records they are the model that is reported
        fitted = as_array(
            times.nrmse if explained(found) else time_errors(found.model, records, system.outputs, at_rest)
        )
    return BeforeAfter(as_array(time_errors(sensed, records, system.outputs, at_rest)), cbsi, fitted)
