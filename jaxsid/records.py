"""The immutable values that flow through the library: records in, models out. No algorithm lives here."""

import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

HOLDS = ("zero", "first", "band")
SENSOR_KINDS = ("displacement", "velocity", "acceleration")


Values = ArrayLike | Sequence[Any]  # an array, or lists of numbers
Steps = tuple[int, ...] | range  # increasing from 0; a range costs nothing to look at, however long it is


def warn_single_precision(x: Array) -> None:
    """Warn, once for each place that builds data, where the data is in single precision."""
    if x.dtype == jnp.float32:
        warnings.warn(
            "single precision costs accuracy: poles near the unit circle need double. Switch it on before building "
            "data: jax.config.update('jax_enable_x64', True).",
            stacklevel=3,
        )


def as_array(x: Values) -> Array:
    """What jnp.asarray gives, but without a compiled program for every new shape of a numpy array."""
    return jax.device_put(x) if isinstance(x, np.ndarray) else jnp.asarray(x)


def floating(x: Values) -> Array:
    """An array of the default floating type, unless it is one of another floating type already."""
    x = as_array(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))


def columns(x: Values) -> Array:
    """A (samples, channels) array; one channel may be given as a vector."""
    x = floating(x)
    return x[:, None] if x.ndim == 1 else x


def named(names: Sequence[str] | None, kind: str, count: int) -> tuple[str, ...]:
    """The names given, or kind1, kind2, ..."""
    return tuple(names) if names is not None else tuple(f"{kind}{i + 1}" for i in range(count))


def holds(hold: str | Sequence[str], count: int) -> tuple[str, ...]:
    """One hold for each input."""
    return (hold,) * count if isinstance(hold, str) else tuple(hold)


class Record(eqx.Module):
    """One experiment: what went in, what came out, sampled uniformly.

    Row k is the instant t_k = k dt. With hold "zero" the input u_k acts from t_k to t_(k+1).
    A row of `y` may be NaN in whole columns only where a sensor was absent from this record.

    Attributes:
        u: inputs (samples, inputs), force N or torque N m.
        y: outputs (samples, outputs), SI units.
        dt: sampling interval, s.
        inputs: input names.
        outputs: output names.
        hold: behaviour of each input between samples, "zero", "first" or "band".
        name: where the record came from, for messages.
    """

    u: Float[Array, "samples inputs"]
    y: Float[Array, "samples outputs"]
    dt: Float[Array, ""]
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        u: Values,
        y: Values,
        dt: Values,
        *,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        hold: str | Sequence[str] = "zero",
        name: str = "record",
    ):
        u, y = columns(u), columns(y)
        self.u, self.y, self.dt = u, y, jnp.asarray(dt, dtype=y.dtype)
        self.inputs = named(inputs, "input", u.shape[-1])
        self.outputs = named(outputs, "output", y.shape[-1])
        self.hold = holds(hold, u.shape[-1])
        self.name = name
        warn_single_precision(y)


class ImpulseResponse(eqx.Module):
    """Markov parameters: Y_0 = D, Y_k = C A^(k-1) B.

    With a `pole` a other than zero the samples are Markov parameters in the Laguerre shift
    w = (z - a) / (1 - a z) instead of z: G(z) = sum_k h_k w^-k. It resolves a band far below
    the sampling rate without decimating.

    Attributes:
        h: (samples, outputs, inputs), h[0] the feedthrough.
        dt: sampling interval, s.
        pole: real Laguerre pole, |pole| < 1; 0 for ordinary time samples.
        noise_std: estimated standard deviation of the noise on each output of the record, (outputs,).
        band: frequencies (Hz) between which the estimate is trusted.
        hold: behaviour of each input between samples; "band" means the bilinear map of continuous time.
        method: how it was estimated, in words.
    """

    h: Float[Array, "samples outputs inputs"]
    dt: Float[Array, ""]
    pole: Float[Array, ""]
    noise_std: Float[Array, " outputs"] | None
    band: Float[Array, "2"] | None
    hold: tuple[str, ...] = eqx.field(static=True)
    method: str = eqx.field(static=True)

    def __init__(
        self,
        h: Values,
        dt: Values,
        *,
        pole: Values = 0.0,
        noise_std: Values | None = None,
        band: Values | None = None,
        hold: str | Sequence[str] = "zero",
        method: str = "given",
    ):
        self.h = floating(h)
        self.dt = jnp.asarray(dt, dtype=self.h.dtype)
        self.pole = jnp.asarray(pole, dtype=self.h.dtype)
        self.noise_std = None if noise_std is None else floating(noise_std)
        self.band = None if band is None else floating(band)
        self.hold = holds(hold, self.h.shape[-1])
        self.method = method


class Realization(eqx.Module):
    """A discrete-time state-space model x' = A x + B u, y = C x + D u, and the factors it came from.

    Attributes:
        A, B, C, D: (n, n), (n, inputs), (outputs, n), (outputs, inputs).
        dt: sampling interval, s.
        singular_values: of the matrix that was factored, largest first, as many as were computed; None if unknown.
        observability: (row blocks * outputs, n), in the shift in which the Hankel matrix was formed.
        controllability: (n, column blocks * inputs), likewise.
        pole: Laguerre pole of that shift, 0 for the ordinary one.
        row_steps, column_steps: time index of each block row and block column, in that shift.
        hold: behaviour of each input between samples.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n inputs"]
    C: Float[Array, "outputs n"]
    D: Float[Array, "outputs inputs"]
    dt: Float[Array, ""]
    singular_values: Float[Array, " k"] | None
    observability: Float[Array, "rows n"] | None
    controllability: Float[Array, "n cols"] | None
    pole: Float[Array, ""]
    row_steps: Steps = eqx.field(static=True)
    column_steps: Steps = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        A: Values,
        B: Values,
        C: Values,
        D: Values,
        dt: Values,
        *,
        singular_values: Values | None = None,
        observability: Values | None = None,
        controllability: Values | None = None,
        pole: Values = 0.0,
        row_steps: Steps = (),
        column_steps: Steps = (),
        hold: str | Sequence[str] = "zero",
    ):
        self.A, self.B, self.C, self.D = (floating(x) for x in (A, B, C, D))
        self.dt = jnp.asarray(dt, dtype=self.A.dtype)
        self.singular_values = None if singular_values is None else floating(singular_values)
        self.observability = None if observability is None else floating(observability)
        self.controllability = None if controllability is None else floating(controllability)
        self.pole = jnp.asarray(pole, dtype=self.A.dtype)
        self.row_steps, self.column_steps = row_steps, column_steps
        self.hold = holds(hold, self.B.shape[-1])


class ContinuousModel(eqx.Module):
    """A continuous-time state-space model x' = A x + B u, y = C x + D u.

    Attributes:
        A, B, C, D: (n, n), (n, inputs), (outputs, n), (outputs, inputs), time in s.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n inputs"]
    C: Float[Array, "outputs n"]
    D: Float[Array, "outputs inputs"]


class Indicators(eqx.Module):
    """How far each mode is to be trusted; every array is (n,), one entry a pole, 1 is best but for msv.

    Attributes:
        mac: modal amplitude coherence.
        msv: mode singular value, its share in the response, in the unit of the response.
        emac: extended modal amplitude coherence.
        mpc: modal phase collinearity.
        cmi: consistent-mode indicator, emac * mpc.
    """

    mac: Float[Array, " n"]
    msv: Float[Array, " n"]
    emac: Float[Array, " n"]
    mpc: Float[Array, " n"]
    cmi: Float[Array, " n"]


class ModalModel(eqx.Module):
    """Poles and shapes of a continuous-time model, slowest first, conjugate pairs adjacent.

    Attributes:
        poles: (n,) complex, 1/s.
        frequencies: (n,) undamped natural frequencies abs(pole), rad/s.
        damping_ratios: (n,) -real(pole) / abs(pole).
        shapes: (outputs, n) complex, C times the eigenvectors.
        participation: (n, inputs) complex, the input rows that go with `shapes`.
        feedthrough: (outputs, inputs).
        indicators: None where the model did not come from a realization.
    """

    poles: Complex[Array, " n"]
    frequencies: Float[Array, " n"]
    damping_ratios: Float[Array, " n"]
    shapes: Complex[Array, "outputs n"]
    participation: Complex[Array, "n inputs"]
    feedthrough: Float[Array, "outputs inputs"]
    indicators: Indicators | None


class SecondOrderModel(eqx.Module):
    """M q'' + D q' + K q = B u, with y = H_d q + H_v q' + H_a q''.

    Attributes:
        mass, damping, stiffness: (N, N), kg, N s/m, N/m (or kg m^2, N m s, N m).
        input_matrix: B (N, inputs).
        displacement_sensors, velocity_sensors, acceleration_sensors: H_d, H_v, H_a (outputs, N).
        diagnostics: what CBSI noticed, None for a model that was not identified.
    """

    mass: Float[Array, "N N"]
    damping: Float[Array, "N N"]
    stiffness: Float[Array, "N N"]
    input_matrix: Float[Array, "N inputs"]
    displacement_sensors: Float[Array, "outputs N"]
    velocity_sensors: Float[Array, "outputs N"]
    acceleration_sensors: Float[Array, "outputs N"]
    diagnostics: "CbsiDiagnostics | None"


class CbsiDiagnostics(eqx.Module):
    """How consistent a realization is with M q'' + D q' + K q = B u; every entry is 0 for a perfect one.

    Attributes:
        upper_block_error: displacement sensors moved at once by a force, C B, against M^-1 B_u / norm(A): the
            upper half of B_I, which is zero when that of A_I is [0, I].
        feedthrough_error: feedthrough D less M^-1 B_u for accelerometers, or less 0 for others, relative.
        mass_asymmetry, damping_asymmetry, stiffness_asymmetry: norm(X - X') / norm(X + X').
        negative_scales: number of negative s_i^2 (by Sylvester's law, of negative eigenvalues of M^-1), each a
            mode whose driving point contradicts its shape.
    """

    upper_block_error: Float[Array, ""]
    feedthrough_error: Float[Array, ""]
    mass_asymmetry: Float[Array, ""]
    damping_asymmetry: Float[Array, ""]
    stiffness_asymmetry: Float[Array, ""]
    negative_scales: Float[Array, ""]


class Residuals(eqx.Module):
    """What a model leaves of a record: is it noise, and has it to do with the inputs?

    Attributes:
        lags: (lags,) s.
        autocorrelation: (lags, outputs) of what is left, 1 at lag 0; white noise has 0 elsewhere.
        cross_correlation: (lags, outputs, inputs) of what is left, made white, with each input, from before to after.
        white_limit: what white noise exceeds once in a hundred times.
        cross_limit: (outputs, inputs) what noise that is independent of the input exceeds once in a hundred times.
        cross_lags: (lags,) s.
    """

    lags: Float[Array, " lags"]
    autocorrelation: Float[Array, "lags outputs"]
    white_limit: float
    cross_lags: Float[Array, " crosslags"]
    cross_correlation: Float[Array, "crosslags outputs inputs"]
    cross_limit: Float[Array, "outputs inputs"]
