"""What `identify` finds: one immutable value that the report, the JSON and the model file are written from."""

import equinox as eqx
from jaxtyping import Array, Complex, Float

from jaxsid.mechanics.lumped import LumpedModel
from jaxsid.physical.elements import ElementValues
from jaxsid.realization.stabilization import Stabilization
from jaxsid.records import (
    ContinuousModel,
    ImpulseResponse,
    ModalModel,
    Realization,
    Record,
    Residuals,
    SecondOrderModel,
)


class MatrixDeviation(eqx.Module):
    """Standard deviations of mass, damping and stiffness.

    Attributes:
        mass, damping, stiffness: of every entry, (N, N).
        ground_damping, ground_stiffness: of the sum of every row, which is what joins a body to the ground, (N,).
    """

    mass: Float[Array, "N N"]
    damping: Float[Array, "N N"]
    stiffness: Float[Array, "N N"]
    ground_damping: Float[Array, " N"]
    ground_stiffness: Float[Array, " N"]


class FrequencyFit(eqx.Module):
    """Measured and modelled frequency response of one record, acceleration, velocity or displacement per force.

    Attributes:
        frequencies: (lines,) Hz.
        measured: (lines, outputs, inputs), NaN where it was not measured.
        coherence: (lines, outputs) multiple coherence, NaN likewise.
        realization: (lines, outputs, inputs) of the identified state-space model.
        matrices: (lines, outputs, inputs) of the identified mass, damping and stiffness; None without them.
    """

    frequencies: Float[Array, " lines"]
    measured: Complex[Array, "lines outputs inputs"]
    coherence: Float[Array, "lines outputs"]
    realization: Complex[Array, "lines outputs inputs"]
    matrices: Complex[Array, "lines outputs inputs"] | None


class Identification(eqx.Module):
    """Everything that was identified from the records of one system.

    Attributes:
        nominal: the model that the user gave.
        records: what was measured.
        outputs: names of the outputs of all results below, the model's sensors that some record holds.
        response: estimated impulse response, in the Laguerre shift where its pole is not 0.
        time_response: (samples, outputs, inputs) impulse response of the realization, at the interval of the records.
        realization: discrete-time state-space model.
        continuous: the same in continuous time.
        order: number of states.
        order_reason: why this order, in words.
        stabilization: poles over orders.
        modal: poles, shapes and indicators.
        frequency_std, damping_ratio_std: (n,) standard deviations of frequencies (rad/s) and damping ratios.
        pole_std: (n,) standard deviation of the real part + 1j times that of the imaginary part, 1/s.
        shape_std: (outputs, n) likewise of the shapes as displacements with largest component 1; NaN without matrices.
        cbsi: mass, damping and stiffness by CBSI alone; None where impossible.
        refined: whether mass, damping and stiffness were fitted to the records; those of CBSI stand otherwise.
        matrices: mass, damping and stiffness, symmetric, that fit the records best; without refinement those of CBSI as
            they come; None where impossible.
        matrices_std: their standard deviations; None without refinement.
        elements: values of the model's own elements, where their matrices fit the records as well as any; else None.
        entries: the largest entries of fitted matrices that are not made of elements; else None.
        identified: `matrices` as a model file; None where impossible.
        predictions: response of the identified model to each record's inputs, initial state estimated.
        train_nrmse, noise_floor: (outputs,) rms(y - yhat) / std(y), and what pure noise would leave.
        nominal_nrmse, cbsi_nrmse, matrices_nrmse: (outputs,) the same of the model that the user gave (its linear
            part), of CBSI's matrices and of the fitted ones, each from its own initial states; None without them.
        residuals: correlations of what the predictions leave, one a record; none of an unstable system.
        frequency_fit: measured and modelled frequency responses, one a record.
        warnings: what the user should know.
    """

    nominal: LumpedModel
    records: tuple[Record, ...]
    outputs: tuple[str, ...] = eqx.field(static=True)
    response: ImpulseResponse
    time_response: Float[Array, "samples outputs inputs"]
    realization: Realization
    continuous: ContinuousModel
    order: int = eqx.field(static=True)
    order_reason: str = eqx.field(static=True)
    stabilization: Stabilization
    modal: ModalModel
    frequency_std: Float[Array, " n"]
    damping_ratio_std: Float[Array, " n"]
    pole_std: Complex[Array, " n"]
    shape_std: Complex[Array, "outputs n"]
    cbsi: SecondOrderModel | None
    refined: bool = eqx.field(static=True)
    matrices: SecondOrderModel | None
    matrices_std: MatrixDeviation | None
    elements: ElementValues | None
    entries: ElementValues | None
    identified: LumpedModel | None
    predictions: tuple[Float[Array, "_ outputs"], ...]
    train_nrmse: Float[Array, " outputs"]
    noise_floor: Float[Array, " outputs"]
    nominal_nrmse: Float[Array, " outputs"]
    cbsi_nrmse: Float[Array, " outputs"] | None
    matrices_nrmse: Float[Array, " outputs"] | None
    residuals: tuple[Residuals, ...]
    frequency_fit: tuple[FrequencyFit, ...]
    warnings: tuple[str, ...] = eqx.field(static=True)
