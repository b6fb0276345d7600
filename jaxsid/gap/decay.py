"""Free decays of a system taken out of a signal, whatever their frequencies, so that what is left tells of noise.

A linear system goes from the response of one period of its input to that of the next by a free decay, and two records
of one input differ by one. A model that is a little off has other frequencies: its own decays would leave most of it.
"""

import numpy as np
from jaxtyping import Float

WIDE = 1.5  # times the fastest rate of a model, up to which a system's own may lie
ROWS = 8  # blocks of the Hankel matrix, for each state
LARGEST = 256  # rows of it that are wanted at most


def without_decays(
    signal: Float[np.ndarray, "samples outputs"], states: int, fastest: float
) -> Float[np.ndarray, "samples outputs"]:
    """What so many exponentials, common to all outputs, leave of a signal.

    x_t = sum_k c_k z_k^t + e_t; the z_k are eigenvalues of the shift between rows of the block Hankel matrix of x, the
    c_k follow by least squares. White e adds as much to all eigenvalues of its Gram matrix and does not turn it.

    Args:
        signal: finite, without inputs.
        states: number of exponentials.
        fastest: largest rate to expect, radians a sample; a shift takes no more than a turn of it.

    Returns:
        e, scaled so that its variance is that of the noise.

    Source: R. Roy, A. Paulraj, T. Kailath, IEEE Trans. Acoust. Speech Signal Process. 34 (1986), ESPRIT.
    """
    samples, outputs = signal.shape
    shift = int(np.clip(np.pi / (WIDE * max(fastest, 1e-3)), 1, max(samples // (4 * states), 1)))
    rows = max(min(ROWS * states, LARGEST // outputs), states // outputs + 2)
    columns = samples - (rows - 1) * shift
    if columns <= 2 * states:
        return signal
    size = np.sqrt((signal**2).mean(axis=0))
    scaled = signal / np.where(size > 0, size, 1.0)
    hankel = np.stack([scaled[i * shift : i * shift + columns] for i in range(rows)])
    hankel = hankel.transpose(0, 2, 1).reshape(rows * outputs, columns)
    observability = np.linalg.svd(hankel @ hankel.T)[0][:, :states]
    turn = np.linalg.lstsq(observability[:-outputs], observability[outputs:], rcond=None)[0]
    poles = np.linalg.eigvals(turn)
    rate = np.log(poles.astype(complex) + 1e-300) / shift
    # what grows from period to period is no free decay
    rate = np.minimum(rate.real, 0.0) + 1j * rate.imag
    waves = np.exp(np.arange(samples)[:, None] * rate)
    basis = np.linalg.qr(np.concatenate([waves.real, waves.imag], axis=1))[0]
    left = signal - basis @ (basis.T @ signal)
    return left * np.sqrt(samples / (samples - states))
