"""A twin of the rig: its torque loop, its mechanics and its sensors, integrated step by step on its own.

The numbers of `systems.rig` stand here again as plain matrices, so that nothing of the library's own
assembly or simulation has a part in this truth.
"""

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxsid.checks import require
from jaxsid.examples.excitation import stepped_sine
from jaxsid.examples.truth import hold_step
from jaxsid.records import Record

SAMPLING_INTERVAL = 1e-3  # s
INERTIA = (0.0053, 0.18)  # motor with gearbox, load; kg m^2, referred to the load side
STIFFNESS, GEAR_DAMPING = 9365.0, 0.8268
BEARING_DAMPING = (0.4352, 0.4782)
ANTI_RESONANCE = np.sqrt(STIFFNESS / INERTIA[1])  # rad/s: the motor stands, the load swings on the gearbox
TORQUE_LOOP_BANDWIDTH = 1000.0  # Hz
COUPLING = 16.0  # N m s/rad from the load's speed into the torque, at the anti-resonance
COUPLING_DAMPING = 0.1  # half the relative width of the band in which it acts
RESOLVER_RANGE = 125.0  # rev/s of the motor shaft, either way: full scale of the converter's speed word
GEAR_RATIO = 10.0


def rig_torque(*, amplitude: float = 5.0) -> Float[np.ndarray, " samples"]:
    """The torque demanded of the rig: 20 to 350 Hz in 0.5 Hz steps, 16 cycles each, 92108 samples at 1 kHz.

    The sweep takes 92015 samples; the first 93 are at rest.

    Args:
        amplitude: N m.
    """
    return stepped_sine(20.0, 350.0, step=0.5, cycles=16, dt=SAMPLING_INTERVAL, amplitude=amplitude, rest=93)


def rig_record(
    seed: int | np.random.Generator,
    *,
    demand: ArrayLike | None = None,
    gyro_noise: float = 0.01,
    torque_noise: float = 0.005,
    resolver_bits: int | None = 16,
    friction: float = 0.0,
    substeps: int = 20,
) -> Record:
    """A record of the rig's twin from rest: effective torque in, motor and load velocity out, 1 kHz.

    The drive updates its torque once a sample and holds it: a first-order lag of 1 kHz behind the demand,
    disturbed around the anti-resonance (36 Hz) by what the load's speed couples into it. The recorded torque
    is the one produced, plus white noise. The gyro has white noise. The resolver's converter gives the
    motor's speed as a word of `resolver_bits` bits over +-125 rev/s of the shaft: 0.0024 rad/s a bit behind
    the gear, with 16; its tracking delay counts as compensated. With friction, a set-valued Coulomb law
    between motor and ground is solved at the end of each substep.

    Args:
        seed: of the noise, or a generator.
        demand: (samples,) torque demanded, N m; `rig_torque()` by default.
        gyro_noise: standard deviation relative to the rms of the load's velocity.
        torque_noise: standard deviation relative to the rms of the torque.
        resolver_bits: of the converter; None for no quantisation.
        friction: Coulomb torque on the motor, N m.
        substeps: integration steps a sample with friction; without it one step is exact.

    Raises:
        InputError: negative noise or friction, no bits or substeps, a demand that is not a vector.
    """
    require(
        min(gyro_noise, torque_noise, friction) >= 0, "rig_record: noise and friction must not be negative."
    )
    require(
        resolver_bits is None or resolver_bits > 0, "rig_record: the resolver needs a bit at least, or None."
    )
    require(substeps > 0, f"rig_record: needs a substep at least, not {substeps}.")
    wanted = rig_torque() if demand is None else np.asarray(demand, dtype=float)
    require(wanted.ndim == 1, f"rig_record: the demand must be a vector, not of shape {wanted.shape}.")
    torque, velocity = _run(wanted, friction, substeps if friction else 1)
    rng = np.random.default_rng(seed)
    gyro = _noisy(rng, velocity[:, 1], gyro_noise)
    resolver = velocity[:, 0] if resolver_bits is None else _quantised(velocity[:, 0], resolver_bits)
    return Record(
        _noisy(rng, torque, torque_noise),
        np.stack([resolver, gyro], axis=1),
        SAMPLING_INTERVAL,
        inputs=("torque",),
        outputs=("resolver", "gyro"),
        name="rig",
    )


def _system() -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 1"]]:
    """States: motor and load angle, motor and load velocity, and the band-pass of the load's velocity.

    The band-pass is 2 z w s / (s^2 + 2 z w s + w^2) at the anti-resonance w; its output is the fifth state.
    """
    jm, jl = INERTIA
    dm, dl = BEARING_DAMPING
    k, c = STIFFNESS, GEAR_DAMPING
    w, width = ANTI_RESONANCE, 2 * COUPLING_DAMPING * ANTI_RESONANCE
    A = np.array(
        [
            [0, 0, 1, 0, 0, 0],
            [0, 0, 0, 1, 0, 0],
            [-k / jm, k / jm, -(c + dm) / jm, c / jm, 0, 0],
            [k / jl, -k / jl, c / jl, -(c + dl) / jl, 0, 0],
            [0, 0, 0, width, -width, -(w**2)],
            [0, 0, 0, 0, 1, 0],
        ]
    )
    return A, np.array([[0, 0, 1 / jm, 0, 0, 0]]).T


def _run(demand: np.ndarray, friction: float, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """The torque held from each instant on, and the two velocities at that instant.

    Held over a substep, the friction x[2] / push[2] would just stop the motor; it is clipped to +-friction.
    """
    step, push = hold_step(*_system(), SAMPLING_INTERVAL / substeps)
    push = push[:, 0]
    lag = np.exp(-2 * np.pi * TORQUE_LOOP_BANDWIDTH * SAMPLING_INTERVAL)
    x, produced = np.zeros(6), 0.0
    torque, states = np.zeros(len(demand)), np.zeros((len(demand), 6))
    for k, wanted in enumerate(demand):
        produced = lag * produced + (1 - lag) * wanted - COUPLING * x[4]
        torque[k], states[k] = produced, x
        for _ in range(substeps):
            x = step.dot(x) + push * produced
            if friction:
                x = x - push * min(max(x[2] / push[2], -friction), friction)
    return torque, states[:, 2:4]


def _noisy(rng: np.random.Generator, signal: np.ndarray, relative: float) -> np.ndarray:
    return signal + relative * np.sqrt(np.mean(signal**2)) * rng.standard_normal(len(signal))


def _quantised(velocity: np.ndarray, bits: int) -> np.ndarray:
    bit = 2 * RESOLVER_RANGE * 2 * np.pi / GEAR_RATIO / 2**bits
    return bit * np.round(velocity / bit)
