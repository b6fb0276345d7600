"""Structures like those that identification methods were tried on, for studies of noise.

Each is like its namesake in size, frequencies and damping; none is its published model.
"""

from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsid.checks import require
from jaxsid.mechanics.lumped import Connection, Input, LumpedModel, Matrices, Sensor, lumped_model
from jaxsid.records import ContinuousModel

GRID_SPEED = 2 * np.pi * 60  # rad/s, electrical and mechanical: two poles
SHAFT_POWER = 892.4e6  # W


class ModalStructure(NamedTuple):
    """A structure by its modes, of which some are excited well.

    Attributes:
        model: displacements or accelerations for forces.
        frequencies: undamped, of the modes that are excited well, Hz.
        damping_ratios: of these.
        inputs, outputs: their names.
        name: for messages.
    """

    model: ContinuousModel
    frequencies: tuple[float, ...]
    damping_ratios: tuple[float, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    name: str


def chain(bodies: int) -> LumpedModel:
    """Masses of 1 kg in a uniform chain between two walls, k = 100 N/m and c = 0.2 N s/m; a force and a sensor on each.

    Its frequencies are 20 sin(i pi / (2 bodies + 2)) rad/s, its damping ratios 0.001 times these.

    Args:
        bodies: number of masses.

    Raises:
        InputError: no mass.
    """
    require(bodies >= 1, f"a chain needs a mass at least, not {bodies}.")
    names = [f"mass{i + 1}" for i in range(bodies)]
    stops = ["ground", *names, "ground"]
    joints = [Connection(f"spring{i + 1}", (stops[i], stops[i + 1])) for i in range(bodies + 1)]
    return lumped_model(
        names,
        [1.0] * bodies,
        [100.0] * len(joints),
        [0.2] * len(joints),
        connections=joints,
        inputs=[Input(f"force{i + 1}", name) for i, name in enumerate(names)],
        sensors=[Sensor(f"sensor{i + 1}", name, "acceleration") for i, name in enumerate(names)],
        name=f"{bodies} DOF chain",
    )


def railway_vehicle() -> LumpedModel:
    """A coach on two bogies, vertical motion of the suspension points and the bogies, rail held still.

    The coach (32 t, pitch inertia 1.97e6 kg m^2) is described by the displacements of the two points 19 m apart at
    which it rests on its bogies, M = [[m/4 + J/L^2, m/4 - J/L^2], [., .]]; the rear bogie carries motors (3.4 t
    against 2.6 t). Air springs of 860 kN/m and 40 kN s/m a bogie above, 4.88 MN/m and 16 kN s/m below. The coach moves
    at 1.1 and 1.3 Hz with 13 and 16 % of critical damping, the bogies at 6.5 and 7.4 Hz with 21 and 24 %. A force and
    an accelerometer at each coordinate.

    Source: numbers of the size of vehicle 1 of the Manchester benchmarks (S. Iwnicki, Vehicle System Dynamics 30,
    1998); the simplification after A. Petsounis and S. Fassois, Mechanical Systems and Signal Processing 15, 2001.
    """
    mass, pitch, length = 32e3, 1.97e6, 19.0
    same, other = mass / 4 + pitch / length**2, mass / 4 - pitch / length**2
    inertia = np.diag([0.0, 0.0, 2615.0, 3400.0])
    inertia[:2, :2] = [[same, other], [other, same]]
    names = ("coach_front", "coach_rear", "bogie_front", "bogie_rear")
    return lumped_model(
        names,
        matrices=Matrices(
            jnp.asarray(inertia),
            jnp.asarray(_two_storeys(40e3, 16e3)),
            jnp.asarray(_two_storeys(860e3, 4.88e6)),
        ),
        inputs=[Input(f"force_{name}", name) for name in names],
        sensors=[Sensor(f"acceleration_{name}", name, "acceleration") for name in names],
        name="railway vehicle",
    )


def _two_storeys(above: float, below: float) -> Float[np.ndarray, "4 4"]:
    """Each end of the coach on its bogie, each bogie on the rail."""
    eye = np.eye(2)
    return np.block([[above * eye, -above * eye], [-above * eye, (above + below) * eye]])


def turbine_generator() -> LumpedModel:
    """The shaft of a turbine-generator: HP, IP, LPA, LPB, generator and exciter, tied to the grid by the generator.

    Inertia constants H = 0.0929, 0.1556, 0.8587, 0.8842, 0.8685, 0.0342 s and stiffnesses 19.30, 34.93, 52.04, 70.86,
    2.82 per unit torque a radian on 892.4 MVA give torsion at 15.7, 20.2, 25.6, 32.3 and 47.5 Hz; the grid is a spring
    of 1.5 per unit, which makes the whole shaft swing near 1.6 Hz. The material damps by 6e-5 s times the stiffness,
    the grid by 0.002 and the steam in each turbine by 0.0002 per unit torque for each rad/s. Torque on the generator
    (a fault in the grid) and on HP (steam), speed of each body.

    Source: IEEE Subsynchronous Resonance Task Force, first benchmark model, IEEE Trans. Power Apparatus and Systems
    96, 1977; damping is not given there.
    """
    bodies = ("HP", "IP", "LPA", "LPB", "GEN", "EXC")
    constants = np.array([0.092897, 0.155589, 0.858670, 0.884215, 0.868495, 0.0342165])
    torque = SHAFT_POWER / GRID_SPEED
    shafts = np.array([19.303, 34.929, 52.038, 70.858, 2.822])
    steam = [Connection(f"steam_{name}", ("ground", name)) for name in bodies[:4]]
    joints = [Connection(f"{a}_{b}", (a, b)) for a, b in pairwise(bodies)]
    return lumped_model(
        bodies,
        2 * constants * SHAFT_POWER / GRID_SPEED**2,
        torque * np.concatenate([shafts, [1.5], np.zeros(4)]),
        torque * np.concatenate([6e-5 * shafts, [2e-3], np.full(4, 2e-4)]),
        connections=[*joints, Connection("grid", ("ground", "GEN")), *steam],
        inputs=[Input("torque_GEN", "GEN"), Input("torque_HP", "HP")],
        sensors=[Sensor(f"speed_{name}", name, "velocity") for name in bodies],
        name="turbine-generator",
    )


def mini_mast() -> ModalStructure:
    """A truss mast of 18 bays like Mini-Mast, by its modes: displacements of six bays for three forces at the tip.

    Bending pairs near 0.86 and 6.1 Hz and torsion at 4.2 Hz are excited well; torsion at 22.9 Hz and ten local modes of
    the diagonals between 15 and 20 Hz are a twentieth as strong. Sensors along x, y and around z.

    Source: frequencies after the Mini-Mast control-structure interaction testbed user's guide, NASA TM-102630, 1989;
    shapes are smooth functions of the height, not those of the mast.
    """
    heights = np.arange(3, 19, 3) / 18
    bending = [heights**1.7, heights**1.7 * (heights - 0.78) / 0.22]
    torsion = [np.sin(np.pi / 2 * heights), -np.sin(3 * np.pi / 2 * heights)]
    x, y, z = np.eye(3)
    kinds = [
        (bending[0], x),
        (bending[0], y),
        (torsion[0], z),
        (bending[1], x),
        (bending[1], y),
        (torsion[1], z),
    ]
    local = [(np.sin(np.pi * (2 + i) * heights), np.cos(i + np.arange(3.0))) for i in range(10)]
    shapes = np.stack([np.outer(h, direction).ravel() for h, direction in [*kinds, *local]], axis=1)
    tip = np.stack([d for _, d in kinds[:5]] + [0.05 * d for _, d in [*kinds[5:], *local]])
    frequencies = np.array([0.86, 0.89, 4.19, 6.10, 6.21, 22.9, *np.linspace(14.9, 20.3, 10)])
    damping = np.array([0.018, 0.016, 0.015, 0.012, 0.013, 0.008, *np.full(10, 0.01)])
    model = _modal_model(frequencies, damping, shapes, tip, accelerometers=False)
    sensors = tuple(f"bay{3 * i + 3}_{axis}" for i in range(6) for axis in ("x", "y", "rotation"))
    excited = tuple(frequencies[:5].tolist()), tuple(damping[:5].tolist())
    return ModalStructure(model, *excited, ("force_x", "force_y", "torque"), sensors, "Mini-Mast-like mast")


def galileo() -> ModalStructure:
    """A spacecraft like Galileo in its modal test: 162 accelerometers, one shaker, 45 modes between 13 and 45 Hz.

    Every third mode is excited well, the other thirty are a hundredth as strong. Damping ratios are 0.4 to 1.6 %.
    The shapes are sin(p pi x) sin(q pi y) on a grid of 18 x 9 sensors.

    Source: counts and band after R. Pappa and J.-N. Juang, Galileo spacecraft modal identification using an
    eigensystem realization algorithm, J. Astronautical Sciences 33, 1985.
    """
    modes = np.arange(45)
    p, q = modes % 9 + 1, modes // 9 + 1
    wide, high = np.arange(1, 19) / 19, np.arange(1, 10) / 10
    shapes = (
        np.sin(np.pi * np.multiply.outer(wide, p))[:, None] * np.sin(np.pi * np.multiply.outer(high, q))[None]
    )
    frequencies = 13 + 32 * (modes + 0.25 * np.sin(5.0 * modes)) / 44
    damping = 0.01 + 0.006 * np.cos(3.0 * modes)
    strong = modes % 3 == 0
    force = np.where(strong, 1.0, 0.01)[:, None]
    model = _modal_model(frequencies, damping, shapes.reshape(162, 45), force, accelerometers=True)
    excited = tuple(frequencies[strong].tolist()), tuple(damping[strong].tolist())
    sensors = tuple(f"accelerometer{i + 1}" for i in range(162))
    return ModalStructure(model, *excited, ("shaker",), sensors, "Galileo-like spacecraft")


def _modal_model(
    frequencies: Float[np.ndarray, " modes"],
    damping: Float[np.ndarray, " modes"],
    shapes: Float[np.ndarray, "outputs modes"],
    forces: Float[np.ndarray, "modes inputs"],
    *,
    accelerometers: bool,
) -> ContinuousModel:
    """p'' + 2 zeta w p' + w^2 p = forces u, y = shapes p or shapes p''; the states of a mode are w p and p'."""
    w = 2 * np.pi * frequencies
    count = len(w)
    A, B = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, forces.shape[1]))
    first, second = np.arange(0, 2 * count, 2), np.arange(1, 2 * count, 2)
    A[first, second], A[second, first], A[second, second] = w, -w, -2 * damping * w
    B[second] = forces
    displacement = np.zeros((count, 2 * count))
    displacement[np.arange(count), first] = 1 / w
    C, D = (
        (shapes @ A[second], shapes @ forces)
        if accelerometers
        else (shapes @ displacement, 0 * shapes @ forces)
    )
    arrays: list[Array] = [jnp.asarray(x) for x in (A, B, C, D)]
    return ContinuousModel(*arrays)
