"""The force of a place over time, with its standard deviation: smoothing with a latent Matern-3/2 force.

State [x, f, f'] with x' = A x + b f and the force f'' = -l^2 f - 2 l f' + white noise of density 4 l^3 s^2, sampled
exactly, seen through y = C x + d f + noise. One Riccati equation gives the constant gain of the forward filter and of
the backward (Rauch-Tung-Striebel) recursion.

Source: J. Hartikainen and S. Sarkka, IEEE Workshop on Machine Learning for Signal Processing, 2010; C. Van Loan, IEEE
Trans. Automatic Control 23 (1978); H. Rauch, F. Tung, C. Striebel, AIAA J. 3 (1965).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

DOUBLINGS = 40  # 2^40 samples: more than any motion takes to settle


class Latent(NamedTuple):
    """A sampled model with one latent force.

    Attributes:
        A: (n + 2, n + 2) over one sampling interval.
        Q: (n + 2, n + 2) covariance of what the force adds in it.
        C: (outputs, n + 2).
        R: (outputs, outputs) covariance of the noise.
    """

    A: Float[Array, "m m"]
    Q: Float[Array, "m m"]
    C: Float[Array, "outputs m"]
    R: Float[Array, "outputs outputs"]


class Smoothed(NamedTuple):
    """Estimates over time and their covariance away from the ends.

    Attributes:
        state: (samples, n + 2) the motion, then the force and its rate.
        covariance: (n + 2, n + 2).
        innovations: (samples, outputs) measured less foretold.
    """

    state: Float[Array, "samples m"]
    covariance: Float[Array, "m m"]
    innovations: Float[Array, "samples outputs"]


def latent_model(
    A: Float[Array, "n n"],
    b: Float[Array, " n"],
    C: Float[Array, "outputs n"],
    d: Float[Array, " outputs"],
    size: Array,
    rate: Array,
    noise: Float[Array, " outputs"],
    dt: Array,
) -> Latent:
    """A continuous-time model with a latent force, sampled.

    Args:
        A: of the model's state.
        b: how the force moves it.
        C: what the sensors see of it.
        d: what they see of the force at once.
        size: standard deviation s of the force.
        rate: l, 1/s.
        noise: standard deviation of each sensor's noise.
        dt: sampling interval, s.
    """
    n = len(A)
    zero = jnp.zeros_like(rate)
    own = jnp.stack([jnp.stack([zero, rate]), jnp.stack([-rate, -2 * rate])])
    whole = jnp.zeros((n + 2, n + 2), A.dtype).at[:n, :n].set(A).at[:n, n].set(b * size).at[n:, n:].set(own)
    # force and rate in units of their own deviations, so that the exponential is of moderate numbers
    white = jnp.zeros_like(whole).at[n + 1, n + 1].set(4 * rate)
    both = jnp.block([[-whole, white], [jnp.zeros_like(whole), whole.T]]) * dt
    steps = jax.scipy.linalg.expm(both)
    unit = jnp.ones(n + 2, A.dtype).at[n].set(size).at[n + 1].set(size * rate)
    F = steps[n + 2 :, n + 2 :].T
    Q = F @ steps[: n + 2, n + 2 :] * unit * unit[:, None]
    F = F * unit[:, None] / unit
    seen = jnp.concatenate([C, d[:, None], jnp.zeros_like(d)[:, None]], axis=1)
    return Latent(F, (Q + Q.T) / 2, seen, jnp.diag(noise**2))


def foretold_covariance(model: Latent) -> Float[Array, "m m"]:
    """P = A (P - P C' (C P C' + R)^-1 C P) A' + Q, by doubling.

    What one step adds is taken into the noise first: P = X + Q, where X solves the same equation with R + C Q C' in
    place of R, A (I - L C) of A and A (Q - L C Q) A' of Q, L = Q C' (R + C Q C')^-1. Its first step divides by that,
    not by R, which loses all digits where sensors hardly have noise.

    Args:
        model: whose states are seen or die out.

    Source: E. Chu, H. Fan, W. Lin, C. Wang, Int. J. Control 77 (2004).
    """
    eye = jnp.eye(len(model.A), dtype=model.A.dtype)

    def double(_: Array, found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        F, G, P = found
        inverse = jnp.linalg.inv(eye + G @ P)
        return F @ inverse @ F, G + F @ inverse @ G @ F.T, P + F.T @ P @ inverse @ F

    A, Q, C, R = model
    S = R + C @ Q @ C.T
    gain = jnp.linalg.solve(S, C @ Q).T
    rest = eye - gain @ C
    filtered = rest @ Q @ rest.T + gain @ R @ gain.T
    start = (A @ rest).T, C.T @ jnp.linalg.solve(S, C), A @ filtered @ A.T
    P = lax.fori_loop(0, DOUBLINGS, double, start)[2] + Q
    return (P + P.T) / 2


def smooth(model: Latent, y: Float[Array, "samples outputs"], start: Float[Array, " m"]) -> Smoothed:
    """Means of the state given all of y, with the gains that hold away from the ends.

    Args:
        model: with its force.
        y: measured, without what the known inputs do.
        start: state foretold for the first sample.
    """
    A, C, P = model.A, model.C, foretold_covariance(model)
    S = C @ P @ C.T + model.R
    gain = jnp.linalg.solve(S, C @ P).T
    filtered_covariance = P - gain @ C @ P
    # states differ by orders of magnitude: in units of their own deviations
    unit = jnp.sqrt(jnp.maximum(jnp.diag(P), jnp.finfo(P.dtype).tiny))
    scaled = P / unit / unit[:, None]
    scaled = scaled + 1e-13 * jnp.eye(len(P), dtype=P.dtype)
    back = (jnp.linalg.solve(scaled, (A @ filtered_covariance) / unit[:, None]) / unit[:, None]).T

    def forward(foretold: Array, seen: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        innovation = seen - C @ foretold
        filtered = foretold + gain @ innovation
        return A @ filtered, (foretold, filtered, innovation)

    _, (foretold, filtered, innovations) = lax.scan(forward, start, y)

    def backward(after: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        own, next_foretold = now
        found = own + back @ (after - next_foretold)
        return found, found

    _, earlier = lax.scan(backward, filtered[-1], (filtered[:-1], foretold[1:]), reverse=True)
    return Smoothed(
        jnp.concatenate([earlier, filtered[-1:]]),
        _inner_covariance(filtered_covariance, back, P),
        innovations,
    )


def _inner_covariance(filtered: Array, back: Array, foretold: Array) -> Array:
    """V = filtered + back (V - foretold) back', by doubling."""
    start = back, filtered - back @ foretold @ back.T
    double = lambda _, x: (x[0] @ x[0], x[1] + x[0] @ x[1] @ x[0].T)  # noqa: E731
    V = lax.fori_loop(0, DOUBLINGS, double, start)[1]
    return (V + V.T) / 2
