"""Benches for the tests of fits: records of the chain, cut and weighed by a noise that is known."""

from types import SimpleNamespace

import numpy as np
from gap_helpers import DT, SAMPLES, chain, drive, exact, record

from jaxsid.gap.hypothesis import FIXED, Moved
from jaxsid.gap.noise import Noise
from jaxsid.gap.refit import Bench
from jaxsid.gap.setting import slowest_rate
from jaxsid.gap.windows import blocks_of, window_length
from jaxsid.mechanics.lumped import second_order
from jaxsid.physical.elements import element_matrices

POLE = 0.5  # of the noise: e_t = POLE e_(t-1) + white
PART = 0.01  # level of the white noise, next to each sensor's reading


def colored(y, seed):
    """Readings with noise, and the level of what is white in it."""
    level = PART * y.std(axis=0)
    white = level * np.random.default_rng(seed).standard_normal((len(y) + 50, y.shape[1]))
    noise = np.zeros_like(white)
    for k in range(1, len(white)):
        noise[k] = POLE * noise[k - 1] + white[k]
    return y + noise[50:], level


def known(level):
    return Noise(np.asarray(level), np.tile([1.0, -POLE], (len(level), 1)), 1e4, "periods")


def motion(u):
    """(samples, 3) displacements and velocities of the linear chain."""
    return tuple(exact(u, [(body, kind) for body in range(3)]) for kind in ("displacement", "velocity"))


def bench(y, level, u=None, model=None, wide=False):
    """One record, cut as `bench_of` does, its noise known and its motion that of the linear chain."""
    model = chain() if model is None else model
    u = drive() if u is None else u
    data = record(u, y)
    length = window_length(slowest_rate(model), DT, SAMPLES)
    q, v = motion(u)
    listed = element_matrices(model).listed
    near = np.array([getattr(model.tolerance, x.quantity) for x in listed])
    far = np.where([x.quantity == "damping" for x in listed], 1.0, 0.3)
    still = np.repeat([np.abs(q).max(), np.abs(v).max()], 3)
    blocks = blocks_of(model, [data], [known(level)], length)
    return Bench(
        model,
        blocks,
        tuple(np.zeros((len(b.y), 6)) for b in blocks),
        (Moved(q, v, u[:, None], np.asarray(y), DT),),
        np.maximum(far if wide else near, FIXED),
        far,
        100.0 * still,
        1,
        2,
        (known(level),),
        (known(level),),
    )


def continuous(model, change):
    """The linear chain with relative changes of its elements: A, and M^-1."""
    plain, elements = second_order(model), element_matrices(model)
    values = np.asarray(elements.nominal) * change
    M, D, K = (
        np.asarray(x) + np.einsum("e,eij->ij", values, np.asarray(d))
        for x, d in zip((plain.mass, plain.damping, plain.stiffness), elements.directions, strict=True)
    )
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    return A, np.linalg.inv(M)


def stepped(model, change):
    """The same sample by sample: x' = E x + F u, y = C x + D u."""
    from scipy.linalg import expm

    A, inverse = continuous(model, change)
    force = inverse @ np.asarray(second_order(model).input_matrix)
    B = np.concatenate([np.zeros((3, 1)), force])
    both = expm(np.block([[A, B], [np.zeros((1, 7))]]) * DT)
    return SimpleNamespace(E=both[:6, :6], F=both[:6, 6], C=A[3:], D=force[:, 0])


def windows_of(block):
    """Inputs, readings and weights of every window from its first sample on, as numpy."""
    u = np.asarray(block.u)[:, block.lead :, 0]
    return u, np.asarray(block.y), np.asarray(block.weight)


def whitened(left, weight, lead):
    """What is left of windows where they judge it, made white; the record's first sample has none before it."""
    white = left - POLE * np.roll(left, 1, axis=1)
    there = (weight > 0) & (np.roll(weight, 1, axis=1) > 0)
    return np.where(there, white * weight, 0.0)[:, lead:]
