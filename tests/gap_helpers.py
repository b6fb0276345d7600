"""A chain of three for the tests of the gap: its model, exact records without effect, records of the reference."""

import numpy as np
from effects_truth import GROUND, Chain, Truth
from scipy.linalg import expm

from jaxsid.mechanics.lumped import Connection, Input, Sensor, lumped_model, second_order
from jaxsid.records import Record

DT, SAMPLES = 0.01, 1024
BODIES = ("b1", "b2", "b3")
MASS, STIFFNESS, DAMPING = [1.0, 1.2, 0.8], [2000.0, 1500.0, 1000.0], [4.0, 3.0, 2.5]
SENSED = ((0, "acceleration"), (1, "acceleration"), (2, "acceleration"))


def chain(kinds=SENSED, factor=1.0, **more):
    """The nominal model; factor multiplies its stiffnesses."""
    ends = ("ground", *BODIES)
    return lumped_model(
        BODIES,
        MASS,
        np.array(STIFFNESS) * factor,
        DAMPING,
        connections=[Connection(f"c{i + 1}", ends[i : i + 2]) for i in range(3)],
        inputs=[Input("drive", "b1")],
        sensors=[Sensor(f"s{body}", BODIES[body], kind) for body, kind in kinds],
        **more,
    )


def drive(samples=SAMPLES, seed=0, periods=1):
    """A random-phase multisine up to 15 Hz, 10 N rms."""
    rng, length = np.random.default_rng(seed), samples // periods
    f = np.fft.rfftfreq(length, DT)
    u = np.fft.irfft(np.where((f > 0.5) & (f < 15), np.exp(2j * np.pi * rng.random(len(f))), 0), length)
    return 10 * np.tile(u / u.std(), periods)


def _sampled(kinds):
    """The linear chain from one sample to the next, (6, 7), and what its sensors read of state and force."""
    plain = second_order(chain(kinds))
    M, D, K, B = (np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness, plain.input_matrix))
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    force = np.concatenate([np.zeros((3, 1)), np.linalg.solve(M, B)])
    step = expm(np.block([[A, force], [np.zeros((1, 7))]]) * DT)

    def read(x, push):
        parts = {"displacement": x[:3], "velocity": x[3:], "acceleration": A[3:] @ x + force[3:, 0] * push}
        return [parts[kind][body] for body, kind in kinds]

    return step[:6], read


def exact(u, kinds=SENSED, start=None):
    """Readings of the linear chain by the matrix exponential."""
    step, read = _sampled(kinds)
    x, y = np.zeros(6) if start is None else np.asarray(start, float), []
    for push in u:
        y.append(read(x, push))
        x = step @ [*x, push]
    return np.array(y)


def fed_back(u, noise, gain, kinds):
    """Force and readings where the first reading, with its noise, is fed back; it has no feedthrough."""
    step, read = _sampled(kinds)
    x, pushes, y = np.zeros(6), [], []
    for wanted, wrong in zip(u, noise, strict=True):
        pushes.append(wanted - gain * (read(x, 0.0)[0] + wrong[0]))
        y.append(read(x, pushes[-1]) + wrong)
        x = step @ [*x, pushes[-1]]
    return np.array(pushes), np.array(y)


def with_effect(u, kind, place, parameters, kinds=SENSED):
    """Readings of the chain with an effect, by the reference integration."""
    plain = second_order(chain(kinds))
    of = Chain(*(np.asarray(x) for x in (plain.mass, plain.damping, plain.stiffness)), 0, kinds)
    return Truth(of, kind, place, parameters, DT).run(u)


def noisy(y, part=0.01, seed=0):
    return y + part * y.std(axis=0) * np.random.default_rng(seed).standard_normal(y.shape)


def record(u, y, kinds=SENSED, name="record"):
    outputs = tuple(f"s{body}" for body, _ in kinds)
    return Record(u[:, None], y, DT, inputs=("drive",), outputs=outputs, name=name)


def silent(text: str) -> None:
    """Says nothing."""


JOINT, WALL = (0, 1), (GROUND, 0)
