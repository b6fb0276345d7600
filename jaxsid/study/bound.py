"""The Cramer-Rao bound: no unbiased estimator has smaller standard deviations, whatever its method.

For samples y(theta) + noise of covariance S the information on theta is J' S^-1 J, J = dy/dtheta, and a quantity
g(theta) has at least the variance g' (J' S^-1 J)^+ g. The noise of each output is independent of the others and of
known colour, so that S^-1/2 is a filter in time (`whitened`); quantization counts as white noise of variance q^2 / 12.

What is unknown: of a system of bodies the symmetric matrices M, D, K (no springs or dampers on free motion), the
places of inputs and sensors being known; of a structure given by its modes, for each mode that is excited well, the
pole, a complex shape at the sensors and a complex participation of the inputs, and the feedthrough of the whole; the
weak modes count as known. Quantities that the samples do not determine, such as masses without a sensor, have no
bound: NaN. A biased estimator may scatter less.

Source: S. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, ch. 3.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.compilation import compiled
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.simulate import markov_parameters
from jaxsid.records import SecondOrderModel
from jaxsid.study.noise import whitened
from jaxsid.study.quantities import Structure, split
from jaxsid.study.system import Mechanics, System

RANK = 1e-10  # singular values of scaled sensitivities, relative, below which a direction leaves no trace
PART = 1e-5  # share of a quantity's gradient in such directions from which on it has no bound


class Sampling(NamedTuple):
    """What is sampled, and its noise.

    Attributes:
        dt: s.
        samples: number of them.
        excitation: (samples,) of the input, one after another; None for an impulse.
        deviation: (outputs,) standard deviation of the noise.
        colour: of the noise.
    """

    dt: float
    samples: int
    excitation: np.ndarray | None
    deviation: np.ndarray
    colour: str


def driven(
    h: Float[np.ndarray, "samples ..."], excitation: np.ndarray | None
) -> Float[np.ndarray, "samples ..."]:
    """The response from rest, y_t = sum_k h_k u_(t-k), to one input after another; h itself for an impulse.

    Args:
        h: Markov parameters, time first.
        excitation: (samples,) u, as long as h; None for an impulse.
    """
    if excitation is None:
        return h
    length = 2 * len(h)
    column = np.fft.rfft(excitation, length).reshape(-1, *[1] * (h.ndim - 1))
    return np.fft.irfft(np.fft.rfft(h, length, axis=0) * column, length, axis=0)[: len(h)]


def cramer_rao(system: System, structure: Structure | None, sampling: Sampling) -> Float[np.ndarray, " q"]:
    """Smallest standard deviations of the quantities that an unbiased estimator can have, NaN where undefined.

    Args:
        system: truth.
        structure: None leaves the matrices out.
        sampling: what is sampled.
    """
    if system.mechanics is None:
        rows, gradient = _by_modes(system, sampling)
    else:
        rows, gradient = _by_matrices(system, system.mechanics, structure, sampling)
    return spread(rows, gradient)


def spread(rows: Float[np.ndarray, "data p"], gradient: Float[np.ndarray, "q p"]) -> Float[np.ndarray, " q"]:
    """sqrt(g' (R' R)^+ g) for each row g of the gradient, NaN where g leaves the row space of R.

    Args:
        rows: derivatives of whitened samples to the unknowns.
        gradient: derivatives of the quantities.
    """
    scale = np.linalg.norm(rows, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(np.linalg.qr(rows / scale, mode="r"))
    s = np.append(s, np.zeros(len(vt) - len(s)))
    seen = s > RANK * s[0]
    along = (gradient / scale) @ vt.T
    lost = np.linalg.norm(along[:, ~seen], axis=1) > PART * np.linalg.norm(along, axis=1)
    return np.where(lost, np.nan, np.linalg.norm(along[:, seen] / s[seen], axis=1))


def _by_matrices(
    system: System, mechanics: Mechanics, structure: Structure | None, sampling: Sampling
) -> tuple[np.ndarray, np.ndarray]:
    directions = _directions(mechanics)
    mass, damping, stiffness = (jnp.asarray(x) for x in directions)
    found = _slopes(mechanics.matrices, mass, damping, stiffness, jnp.asarray(sampling.dt), sampling.samples)
    slopes = np.asarray(found)
    unit = driven(slopes, sampling.excitation) / sampling.deviation[:, None, None]
    rows = whitened(unit, sampling.colour).reshape(-1, slopes.shape[-1])
    gradient = [_pole_rows(system.poles, _pole_slopes(system.poles, mechanics.matrices, directions))]
    if structure is not None:
        upper = np.triu_indices(len(mechanics.matrices.mass))
        blocks = [x[:, upper[0], upper[1]].T for x in directions]
        counts = np.cumsum([0, *(x.shape[1] for x in blocks)])
        padded = [np.pad(x, ((0, 0), (counts[i], counts[3] - counts[i + 1]))) for i, x in enumerate(blocks)]
        gradient += padded
    return rows, np.concatenate(gradient)


def _directions(mechanics: Mechanics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symmetric changes (p, N, N) of M, D and K; those of D and K leave the free motion free."""
    bodies = len(mechanics.matrices.mass)
    every, patterns = np.eye(bodies), (mechanics.setting.loose, mechanics.setting.rigid)
    held = [np.linalg.svd(x)[0][:, x.shape[1] :] if x.shape[1] else every for x in patterns]
    mass, damping, stiffness = (_symmetric(basis) for basis in (every, *held))
    return mass, damping, stiffness


def _symmetric(basis: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "p N N"]:
    i, j = np.triu_indices(basis.shape[1])
    products = basis.T[i, :, None] * basis.T[j, None, :]
    return np.where((i == j)[:, None, None], products, products + np.swapaxes(products, 1, 2))


@compiled
def _slopes(
    model: SecondOrderModel, mass: Array, damping: Array, stiffness: Array, dt: Array, samples: int
) -> Float[Array, "samples outputs inputs p"]:
    """Derivatives of the Markov parameters to the sizes of the changes of M, D and K."""

    def response(sizes: tuple[Array, Array, Array]) -> Array:
        dm, dd, dk = (jnp.tensordot(s, x, 1) for s, x in zip(sizes, (mass, damping, stiffness), strict=True))
        changed = SecondOrderModel(
            model.mass + dm,
            model.damping + dd,
            model.stiffness + dk,
            model.input_matrix,
            model.displacement_sensors,
            model.velocity_sensors,
            model.acceleration_sensors,
            None,
        )
        return markov_parameters(discretise(physical_displacement_velocity(changed), dt), samples=samples)

    zeros = tuple(jnp.zeros(len(x), x.dtype) for x in (mass, damping, stiffness))
    return jnp.concatenate(jax.jacfwd(response)(zeros), axis=-1)


def _pole_slopes(
    poles: Complex[np.ndarray, " k"], model: SecondOrderModel, directions: tuple[np.ndarray, ...]
) -> Complex[np.ndarray, "k p"]:
    """dp = -x' (p^2 dM + p dD + dK) x / (x' (2 p M + D) x) with (p^2 M + p D + K) x = 0, transposes throughout."""
    mass, damping, stiffness = (np.asarray(x) for x in (model.mass, model.damping, model.stiffness))
    slopes = []
    for p in poles:
        x = np.linalg.svd(p**2 * mass + p * damping + stiffness)[2][-1].conj()
        size = x @ (2 * p * mass + damping) @ x
        changes = zip((p**2, p, 1.0), directions, strict=True)
        slopes.append(np.concatenate([-factor * ((d @ x) @ x) / size for factor, d in changes]))
    return np.array(slopes)


def _pole_rows(
    poles: Complex[np.ndarray, " k"], slopes: Complex[np.ndarray, "k p"]
) -> Float[np.ndarray, "q p"]:
    """Derivatives of frequencies (Hz), damping ratios and real poles, in this order, from those of the poles."""
    swing = np.isin(poles, split(poles)[0])
    p, dp = poles[swing, None], slopes[swing]
    size, real = np.abs(p), np.real(p)
    growth = np.real(np.conj(p) * dp) / size
    return np.concatenate(
        [growth / (2 * np.pi), -np.real(dp) / size + real * growth / size**2, np.real(slopes[~swing])]
    )


def _by_modes(system: System, sampling: Sampling) -> tuple[np.ndarray, np.ndarray]:
    """Sensitivities to poles and participations of what the shapes and the feedthrough cannot imitate.

    With y_o = 2 Re sum_k c_ok x_k, x_k(t, input) = b_k g_k(t) and g_k(t) = lambda_k^(t-1), the shapes c_o and the
    feedthrough of output o enter linearly and nowhere else: their columns, the same for all outputs, are projected out.
    """
    poles, c, b = _modes(system, sampling.dt)
    g, slope = _decays(poles, sampling)
    size = b.shape[1]
    eye = np.eye(size)
    local = [(g[:, None] * b.T).reshape(-1, len(poles)), _feedthrough(sampling, size)]
    pole = (slope[:, None] * b.T).reshape(-1, len(poles))
    # the largest participation of each mode is its scale, which the shape has already
    fixed = [int(np.argmax(row)) if row.max() > 1e-12 * np.abs(b).max() else -1 for row in np.abs(b)]
    free = [(k, j) for k in range(len(poles)) for j in range(size) if j != fixed[k]]
    part = [np.outer(g[:, k], eye[j]).ravel() for k, j in free]
    moved = np.stack([*pole.T, *part], axis=1)
    owner = np.array([*range(len(poles)), *(k for k, _ in free)])
    known = _span(np.hstack([_parts(local[0]), local[1]]))
    columns = _parts(moved)
    columns = columns - known @ (known.T @ columns)
    small = np.linalg.qr(columns - known @ (known.T @ columns), mode="r")
    rows = [small @ _turned(shape[owner]) / d for shape, d in zip(c, sampling.deviation, strict=True)]
    slopes = np.hstack([z * np.eye(len(poles), len(owner)) for z in (1.0, 1.0j)])
    return np.concatenate(rows), _pole_rows(system.poles, slopes)


def _modes(system: System, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The judged poles, their shapes (outputs, k) in the sampled model and participations (k, inputs)."""
    A, B, C = (np.asarray(getattr(system.model, name)) for name in "ABC")
    poles, vectors = np.linalg.eig(A)
    chosen = np.argmin(np.abs(poles - system.poles[:, None]), axis=1)
    b, poles = np.linalg.solve(vectors, B)[chosen], poles[chosen]
    return poles, (C @ vectors)[:, chosen] * (np.expm1(poles * dt) / poles), b


def _decays(poles: np.ndarray, sampling: Sampling) -> tuple[np.ndarray, np.ndarray]:
    """Whitened g_k(t) = exp(p_k (t - 1) dt) and its derivative to p_k, driven by the excitation: (samples, k)."""
    t = (np.arange(sampling.samples)[:, None] - 1) * sampling.dt
    g = np.where(t < 0, 0.0, np.exp(poles * np.maximum(t, 0.0)))
    both = np.stack([np.real(g), np.imag(g), np.real(g * t), np.imag(g * t)])
    parts = [whitened(driven(x, sampling.excitation), sampling.colour) for x in both]
    return parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]


def _feedthrough(sampling: Sampling, inputs: int) -> Float[np.ndarray, "data inputs"]:
    spike = np.eye(sampling.samples, 1)[:, 0]
    return np.kron(whitened(driven(spike, sampling.excitation), sampling.colour)[:, None], np.eye(inputs))


def _span(x: Float[np.ndarray, "data k"]) -> Float[np.ndarray, "data rank"]:
    """Orthonormal columns; those of a mode that is not driven are zero and span nothing."""
    size = np.linalg.norm(x, axis=0)
    there = size > 1e-12 * size.max()
    u, s, _ = np.linalg.svd(x[:, there] / size[there], full_matrices=False)
    return u[:, s > RANK * s[0]]


def _parts(x: Complex[np.ndarray, "data k"]) -> Float[np.ndarray, "data two_k"]:
    return np.hstack([np.real(x), np.imag(x)])


def _turned(shape: Complex[np.ndarray, " k"]) -> Float[np.ndarray, "two_k two_k"]:
    """[Re z, Im z] times this is the derivative of 2 Re(c (a + j b) z) to a and to b."""
    real, imag = np.diag(2 * np.real(shape)), np.diag(2 * np.imag(shape))
    return np.block([[real, -imag], [-imag, -real]])
