"""Lumped chains for the tests of refinement: the truth, models that are wrong, exact responses."""

import numpy as np
from band_limited import SEVEN, THREE

from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import Connection, Input, LumpedModel, Sensor, lumped_model, second_order
from jaxsid.mechanics.simulate import impulse_response_of

ONE = ([1.2], [3000.0], [1.5])
CHAINS = {"one": (ONE, 400), "three": (THREE, 400), "seven": (SEVEN, 800)}
DT = 0.002


def truth_of(elements) -> np.ndarray:
    """Masses, dampings, stiffnesses, in the order of the model's values."""
    mass, stiffness, damping = (np.asarray(x, float) for x in elements)
    return np.concatenate([mass, damping, stiffness])


def chain_model(
    elements, factor=None, sensed=None, driven=(0,), kind="acceleration", hold="zero"
) -> LumpedModel:
    """A chain from the ground, its values times factors in the order of `truth_of`."""
    values = truth_of(elements) * (1.0 if factor is None else factor)
    n = len(elements[0])
    mass, damping, stiffness = np.split(values, [n, n + len(elements[2])])
    bodies = [f"b{i + 1}" for i in range(n)]
    ends = ["ground", *bodies, "ground"]
    return lumped_model(
        bodies,
        mass,
        stiffness,
        damping,
        connections=[Connection(f"c{i + 1}", (ends[i], ends[i + 1])) for i in range(len(stiffness))],
        inputs=[Input(f"f{j + 1}", bodies[j], hold) for j in driven],
        sensors=[Sensor(f"s{i + 1}", bodies[i], kind) for i in (range(n) if sensed is None else sensed)],
    )


def exact_response(model, samples=400, dt=DT, hold="zero"):
    """Its impulse response."""
    return impulse_response_of(
        physical_displacement_velocity(second_order(model)), dt, samples=samples, hold=hold
    )


def factors(rng, elements):
    """Within 30 % of one."""
    return 1 + 0.3 * rng.uniform(-1, 1, len(truth_of(elements)))
