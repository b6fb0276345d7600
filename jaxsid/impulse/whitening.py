"""The filter that makes a signal white: Burg's autoregression over segments."""

import numpy as np
from jaxtyping import Float

MOST = 16  # taps after the first


def whitening_filter(segments: Float[np.ndarray, "segments length"]) -> Float[np.ndarray, " taps"]:
    """Coefficients 1, a_1, ..., of the order that Akaike's criterion prefers, zeros up to the highest.

    Args:
        segments: of a signal of zero mean.

    Source: J. P. Burg, Maximum Entropy Spectral Analysis, Society of Exploration Geophysicists, 1967.
    """
    forward, backward = segments[:, 1:], segments[:, :-1]
    taps, error = np.ones(1), (segments**2).mean()
    best, least = taps, segments.size * np.log(max(error, np.finfo(float).tiny))
    for order in range(1, min(MOST, segments.shape[1] // 4) + 1):
        power = (forward**2).sum() + (backward**2).sum()
        if power <= 0:
            break
        k = -2 * (forward * backward).sum() / power
        taps = np.append(taps, 0.0)
        taps = taps + k * taps[::-1]
        error *= max(1 - k**2, np.finfo(float).tiny)
        forward, backward = (forward + k * backward)[:, 1:], (backward + k * forward)[:, :-1]
        criterion = segments.size * np.log(max(error, np.finfo(float).tiny)) + 2 * order
        if criterion < least:
            best, least = taps, criterion
    return np.pad(best, (0, MOST + 1 - len(best)))
