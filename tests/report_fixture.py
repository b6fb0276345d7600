"""An identification made by hand: a chain of three masses, as if found from noisy records."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import scipy.signal

from jaxsid.identification import FrequencyFit, Identification, MatrixDeviation
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import Connection, Input, LumpedModel, Sensor, lumped_model, second_order
from jaxsid.mechanics.simulate import impulse_response_of
from jaxsid.modes import modal
from jaxsid.physical.elements import ElementValues, element_matrices
from jaxsid.pipeline.fit import residuals_of
from jaxsid.realization.era import era
from jaxsid.realization.stabilization import stabilization
from jaxsid.records import CbsiDiagnostics, ImpulseResponse, Record, SecondOrderModel

DT = 0.005
WARNING = "Sensor 'acc3' is <noisy> & weak: its fit is 3 times the noise floor. Check its cable."


def chain(scale: float, *, force: str = "force", name: str = "three-mass <chain>") -> LumpedModel:
    """5, 4 and 3 kg in a chain held at one end; `scale` multiplies the stiffness."""
    places = ("ground", "base", "middle", "top")
    return lumped_model(
        places[1:],
        [5.0, 4.0, 3.0],
        [40e3 * scale, 30e3 * scale, 20e3 * scale],
        [30.0, 20.0, 15.0],
        connections=[Connection(f"spring{i + 1}", (places[i], places[i + 1])) for i in range(3)],
        inputs=[Input(force, "base")],
        sensors=[Sensor(f"acc{i + 1}", body, "acceleration") for i, body in enumerate(places[1:])],
        name=name,
    )


@functools.cache
def identification(samples: int = 4000) -> Identification:
    """What an identification of one record with 2 % noise may look like."""
    nominal, truth = chain(0.9), second_order(chain(1.0))
    continuous = physical_displacement_velocity(truth)
    rng = np.random.default_rng(1)
    sampled = discretise(continuous, DT)
    u = rng.standard_normal((samples, 1)) * 50
    A, B, C, D = (np.asarray(getattr(sampled, x)) for x in "ABCD")
    clean = scipy.signal.dlsim((A, B, C, D, DT), u)[1]
    y = clean + 0.02 * clean.std(axis=0) * rng.standard_normal(clean.shape)
    record = Record(u, y, DT, inputs=("force",), outputs=("acc1", "acc2", "acc3"), name="sweep.csv")
    ir = impulse_response_of(continuous, DT, samples=601)
    h = np.asarray(ir.h)
    noisy = h + 2e-3 * np.abs(h[1:]).max() * rng.standard_normal(h.shape)
    response = ImpulseResponse(
        noisy, DT, noise_std=0.02 * clean.std(axis=0), band=(1.0, 80.0), method="Fourier, three averages"
    )
    realization = era(response, order=6, rows=60, cols=60)
    found_modal = modal(realization)
    n = len(found_modal.poles)
    matrices = SecondOrderModel(
        truth.mass * 1.002, truth.damping * 0.97, truth.stiffness * 1.001, truth.input_matrix,
        truth.displacement_sensors, truth.velocity_sensors, truth.acceleration_sensors, diagnostics=None,
    )  # fmt: skip
    diagnostics = CbsiDiagnostics(*(jnp.asarray(x) for x in (2e-3, 5e-4, 1e-3, 2e-2, 4e-4, 0.0)))
    deviation = MatrixDeviation(
        *(0.004 * jnp.abs(x) + 1e-3 * jnp.abs(x).max() for x in (truth.mass, truth.damping, truth.stiffness)),
        *(0.006 * jnp.abs(x).max(axis=1) for x in (truth.damping, truth.stiffness)),
    )
    rest = np.std(y - clean, axis=0) / np.std(y, axis=0)
    return Identification(
        nominal=nominal,
        records=(record,),
        outputs=("acc1", "acc2", "acc3"),
        response=response,
        time_response=ir.h,
        realization=realization,
        continuous=continuous,
        order=6,
        order_reason="The singular values drop by a factor of 40 after the sixth; all six poles are stable.",
        stabilization=stabilization(response, range(2, 31, 2), rows=60, cols=60),
        modal=found_modal,
        frequency_std=found_modal.frequencies * 2e-4,
        damping_ratio_std=jnp.full(n, 4e-4),
        pole_std=(3e-4 + 2e-4j) * found_modal.frequencies,
        shape_std=jnp.full((3, n), 0.002 + 0.001j),
        cbsi=dataclasses.replace(matrices, diagnostics=diagnostics),
        refined=True,
        matrices=matrices,
        matrices_std=deviation,
        elements=None,
        entries=None,
        identified=chain(1.001),
        predictions=(jnp.asarray(clean),),
        train_nrmse=jnp.asarray(rest * [1.0, 1.3, 3.1]),
        noise_floor=jnp.asarray(rest),
        nominal_nrmse=jnp.asarray([0.4, 0.5, 300.0]),
        cbsi_nrmse=jnp.asarray(rest * [1.1, 1.5, 3.5]),
        matrices_nrmse=jnp.asarray(rest * [1.0, 1.3, 3.1]),
        residuals=residuals_of((record,), ("acc1", "acc2", "acc3"), (jnp.asarray(clean),)),
        frequency_fit=(frequency_fit(record, matrices),),
        warnings=(WARNING,),
    )


def frequency_fit(record: Record, matrices: SecondOrderModel) -> FrequencyFit:
    """Averaged spectra against the response of the matrices, with another model 1 % softer beside it."""
    u, y, rate = np.asarray(record.u)[:, 0], np.asarray(record.y).T, 1 / float(record.dt)
    f, cross = scipy.signal.csd(u, y, rate, nperseg=1000)
    coherence = scipy.signal.coherence(u, y, rate, nperseg=1000)[1]
    measured = cross / scipy.signal.welch(u, rate, nperseg=1000)[1]
    curves = [acceleration_response(matrices, f, factor)[..., None] for factor in (1.0, 0.99)]
    return FrequencyFit(
        jnp.asarray(f),
        jnp.asarray(measured.T[..., None]),
        jnp.asarray(coherence.T),
        *map(jnp.asarray, curves),
    )


def acceleration_response(model: SecondOrderModel, f: np.ndarray, factor: float) -> np.ndarray:
    """(lines, N) acceleration per force at the first body."""
    s = 2j * np.pi * f[:, None, None]
    mass, damping, stiffness = (np.asarray(x) for x in (model.mass, model.damping, model.stiffness))
    return (s**2 * np.linalg.inv(s**2 * mass + s * damping + factor * stiffness))[:, :, 0]


def with_elements(found: Identification) -> Identification:
    """The same where the values of the model's elements explain the records; one damper is not determined."""
    unknowns = element_matrices(found.nominal)
    nominal = jnp.asarray(unknowns.nominal)
    values = ElementValues(
        unknowns.listed,
        1.02 * nominal,
        (0.004 * nominal).at[3].set(jnp.inf),
        jnp.eye(len(nominal)),
        nominal,
    )
    return dataclasses.replace(found, elements=values)


def without_matrices(found: Identification) -> Identification:
    """The same where no matrices and no indicators could be found."""
    fit = tuple(dataclasses.replace(x, matrices=None) for x in found.frequency_fit)
    return dataclasses.replace(
        found, matrices=None, matrices_std=None, cbsi=None, identified=None, frequency_fit=fit,
        cbsi_nrmse=None, matrices_nrmse=None,
        modal=dataclasses.replace(found.modal, indicators=None),
    )  # fmt: skip
