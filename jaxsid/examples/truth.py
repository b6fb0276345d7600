"""Records of linear models by the matrix exponential, independent of the library's own simulation."""

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxsid.checks import require
from jaxsid.examples.excitation import chirp
from jaxsid.examples.systems import one_dof, three_dof
from jaxsid.mechanics.lumped import LumpedModel, second_order
from jaxsid.records import Record


def hold_step(
    A: Float[np.ndarray, "n n"], B: Float[np.ndarray, "n inputs"], dt: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n inputs"]]:
    """Exact step of x' = A x + B u under a held input: exp([[A, B], [0, 0]] dt) = [[A_d, B_d], [0, I]].

    Args:
        A, B: the continuous-time system.
        dt: length of the step, s.
    """
    from scipy.linalg import expm

    n = len(A)
    augmented = np.zeros((n + B.shape[1],) * 2)
    augmented[:n] = np.hstack([A, B])
    step = expm(augmented * dt)
    return step[:n, :n], step[:n, n:]


def exact_record(
    model: LumpedModel, u: ArrayLike, dt: float, *, inputs: tuple[str, ...] | None = None
) -> Record:
    """The response of a linear model from rest to inputs that are held between samples (zero-order hold).

    Args:
        model: a model without effects.
        u: (samples, inputs), N or N m.
        dt: sampling interval, s.
        inputs: names of the model's inputs that the columns of u drive; by default all of them.

    Raises:
        InputError: an unknown input, a wrong number of columns, a model with effects.
    """
    names = tuple(i.name for i in model.inputs)
    chosen = names if inputs is None else tuple(inputs)
    u = np.asarray(u, dtype=float).reshape(len(np.asarray(u)), -1)
    require(not model.effects, f"{model.name}: exact_record is for linear models; this one has effects.")
    require(set(chosen) <= set(names), f"{model.name}: inputs {chosen} are not among {names}.")
    require(u.shape[1] == len(chosen), f"u has {u.shape[1]} columns for {len(chosen)} inputs {chosen}.")
    A, B, C, D = _state_space(model, [names.index(name) for name in chosen])
    step, push = hold_step(A, B, dt)
    driven = u @ push.T
    states = np.zeros((len(u), len(A)))
    for k in range(len(u) - 1):
        states[k + 1] = step.dot(states[k]) + driven[k]
    sensors = tuple(s.name for s in model.sensors)
    return Record(u, states @ C.T + u @ D.T, dt, inputs=chosen, outputs=sensors, name=model.name)


def _state_space(model: LumpedModel, columns: list[int]) -> tuple[np.ndarray, ...]:
    """Displacement-velocity form: A = [[0, I], [-M^-1 K, -M^-1 D]], accelerations by its lower half."""
    so = second_order(model)
    mass, damping, stiffness = (np.asarray(x, dtype=float) for x in (so.mass, so.damping, so.stiffness))
    n = len(mass)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    push = np.linalg.solve(mass, np.asarray(so.input_matrix, dtype=float)[:, columns])
    accelerometers = np.asarray(so.acceleration_sensors, dtype=float)
    A = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])
    B = np.vstack([np.zeros_like(push), push])
    C = np.hstack([so.displacement_sensors, so.velocity_sensors]) + accelerometers @ lower
    return A, B, C, accelerometers @ push


def one_dof_record(*, samples: int = 4096, dt: float = 1e-3) -> Record:
    """The 1 DOF system from rest under a chirp of 0.02 to 3 Hz over 100 s, acceleration, without noise.

    Args:
        samples: how many, from the start of the chirp.
        dt: sampling interval, s.
    """
    return exact_record(one_dof(), chirp(0.02, 3.0, duration=100.0, dt=dt, samples=samples), dt)


def three_dof_records(*, samples: int = 4096, dt: float = 1e-3) -> tuple[Record, Record, Record]:
    """The 3 DOF chain from rest under one force after another: chirps of 0.1 to 10 Hz over 10 s.

    Each record has one input and the three accelerations, without noise.

    Args:
        samples: how many in each record, from the start of the chirp.
        dt: sampling interval, s.
    """
    model, u = three_dof(), chirp(0.1, 10.0, duration=10.0, dt=dt, samples=samples)
    first, second, third = (exact_record(model, u, dt, inputs=(i.name,)) for i in model.inputs)
    return first, second, third
