"""One experiment of a study: from a key to what is identified under that realization of the noise."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.mechanics.simulate import impulse_response_of
from jaxsid.realization.era import era
from jaxsid.realization.era_dc import era_dc
from jaxsid.records import ImpulseResponse, Realization
from jaxsid.study.bound import Sampling, cramer_rao, driven
from jaxsid.study.configuration import Case
from jaxsid.study.factors import resolve
from jaxsid.study.noise import disturbed
from jaxsid.study.quantities import Structure, estimates, names_and_units, split, structure_of, truth_of
from jaxsid.study.records import METHODS, Observer, excitation, one_after_another, prepare_observer
from jaxsid.study.system import make_system


class Plan(eqx.Module):
    """How an experiment is evaluated: the static numbers and words of a case."""

    colour: str = eqx.field(static=True)
    method: str = eqx.field(static=True)
    realization: str = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    order: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    cols: int = eqx.field(static=True)
    stride: int = eqx.field(static=True)
    lags: int = eqx.field(static=True)
    first_lag: int = eqx.field(static=True)
    lag_step: int = eqx.field(static=True)


class Experiment(eqx.Module):
    """Noise on exact samples, a realization, its quantities; call it with a key, inside `ensemble` or not.

    Attributes:
        names, units: of the quantities.
        truth: their true values.
        bound: Cramer-Rao bound of their standard deviations, NaN where there is none.
        exact: samples without noise, (samples, outputs, inputs): Markov parameters, or for each input the response
            to the excitation of that input alone.
        excitation: (samples,), None where the Markov parameters themselves are measured.
        deviation: of the noise on each output, (outputs, 1).
        dt: s.
        swings, still: true poles that are judged, oscillating and real, 1/s.
        observer: prepared for the method "inband".
        structure: what CBSI needs, None where there are no matrices.
        plan: the static rest.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    truth: Float[Array, " q"]
    bound: Float[Array, " q"]
    exact: Float[Array, "samples outputs inputs"]
    excitation: Float[Array, " samples"] | None
    observer: Observer | None
    deviation: Float[Array, "outputs 1"]
    dt: Float[Array, ""]
    swings: Complex[Array, " k"]
    still: Float[Array, " l"]
    structure: Structure | None
    plan: Plan

    def __call__(self, key: Array) -> Float[Array, " q"]:
        """The quantities identified under one realization of the noise; NaN where that failed.

        Args:
            key: of the realization.
        """
        samples = disturbed(self.exact, self.deviation, key, self.plan.colour)
        realization = realize(self.response(samples), self.plan)
        return estimates(realization, self.swings, self.still, self.structure)

    def response(self, y: Float[Array, "samples outputs inputs"]) -> ImpulseResponse:
        """The impulse response that measured samples give.

        Args:
            y: like `exact`.
        """
        if self.excitation is None:
            return ImpulseResponse(y, self.dt)
        if self.observer is not None:
            return self.observer(y, self.dt, self.plan.samples)
        records = one_after_another(self.excitation, y, self.dt)
        return METHODS[self.plan.method](records, self.plan.samples)


def realize(response: ImpulseResponse, plan: Plan) -> Realization:
    """ERA or ERA/DC with the windows of the plan.

    Args:
        response: to realize.
        plan: of the experiment.
    """
    window: dict[str, Any] = {
        "order": plan.order,
        "rows": plan.rows,
        "cols": plan.cols,
        "stride": plan.stride,
    }
    if plan.realization == "era":
        return era(response, **window)
    return era_dc(response, **window, lags=plan.lags, first_lag=plan.first_lag, lag_step=plan.lag_step)


def make_experiment(case: Case) -> Experiment:
    """The experiment of a case: all that the realizations share is computed here, once.

    Args:
        case: of a study; factors that it leaves out are at their defaults.

    Raises:
        InputError: an unknown system, sensor or input, settings that do not go together.
    """
    given: dict[str, Any] = dict(case.values)
    system = make_system(
        given["system"], given.get("sensors", "default"), given.get("inputs", "default"), case.model
    )
    v: dict[str, Any] = resolve(given, system)
    plan = Plan(**{name: v[name] for name in Plan.__dataclass_fields__})
    structure = structure_of(system, plan.order)
    names, units = names_and_units(system, structure)
    truth = truth_of(system, structure)
    swings, still = split(system.poles)
    dt = 1 / v["rate"]
    length = v["record_samples"] or plan.samples
    u = excitation(v["excitation"], length, v["excitation_seed"]) if v["excitation"] else None
    exact = driven(np.asarray(impulse_response_of(system.model, dt, samples=length).h), u)
    size = np.sqrt(np.mean(exact**2, axis=(0, 2)))
    least = cramer_rao(system, structure, Sampling(dt, length, u, size, plan.colour))
    observer = prepare_observer(u, exact) if u is not None and plan.method == "inband" else None
    return Experiment(
        names,
        units,
        truth=jnp.asarray(truth),
        bound=jnp.asarray(v["noise"] * least),
        exact=jnp.asarray(exact),
        excitation=None if u is None else jnp.asarray(u),
        observer=observer,
        deviation=jnp.asarray(v["noise"] * size[:, None]),
        dt=jnp.asarray(dt),
        swings=jnp.asarray(swings),
        still=jnp.asarray(still),
        structure=structure,
        plan=plan,
    )
