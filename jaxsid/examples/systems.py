"""The reference systems as lumped models."""

from collections.abc import Sequence

from jaxsid.mechanics.lumped import Connection, Input, LumpedModel, Sensor, Tolerance, lumped_model

RIG_CONNECTIONS = (
    Connection("gearbox", ("motor", "load")),
    Connection("motor_bearing", ("ground", "motor")),
    Connection("load_bearing", ("ground", "load")),
)
RIG_INPUTS = (Input("torque", "motor"),)
RIG_SENSORS = (Sensor("resolver", "motor", "velocity"), Sensor("gyro", "load", "velocity"))


def one_dof(*, sensor: str = "acceleration") -> LumpedModel:
    """A mass of 1 kg on a spring of 1 N/m and a damper of 0.01 N s/m, pushed and seen.

    Its poles are -0.005 +- 0.99999j 1/s.

    Args:
        sensor: kind of its sensor.
    """
    return lumped_model(
        ["mass"],
        [1.0],
        [1.0],
        [0.01],
        connections=[Connection("spring", ("ground", "mass"))],
        inputs=[Input("force", "mass")],
        sensors=[Sensor("sensor", "mass", sensor)],
        name="1 DOF",
    )


def three_dof(*, sensors: Sequence[str] = ("acceleration", "acceleration", "acceleration")) -> LumpedModel:
    """Three masses of 1 kg in a chain with both ends grounded: k = 2, 2, 2, 20 N/m, c = k / 20.

    A force and a sensor on each mass. Its poles are -0.5556 +- 4.681j, -0.1470 +- 2.420j and
    -0.04745 +- 1.377j 1/s.

    Args:
        sensors: kind of the sensor on each mass.
    """
    chain = ("ground", "mass1", "mass2", "mass3", "ground")
    bodies = chain[1:4]
    return lumped_model(
        bodies,
        [1.0, 1.0, 1.0],
        [2.0, 2.0, 2.0, 20.0],
        [0.1, 0.1, 0.1, 1.0],
        connections=[Connection(f"spring{i + 1}", (chain[i], chain[i + 1])) for i in range(4)],
        inputs=[Input(f"force{i + 1}", body) for i, body in enumerate(bodies)],
        sensors=[
            Sensor(f"sensor{i + 1}", body, kind)
            for i, (body, kind) in enumerate(zip(bodies, sensors, strict=True))
        ],
        name="3 DOF chain",
    )


def rig() -> LumpedModel:
    """A servo motor that drives three discs through a 1:10 planetary gearbox, referred to the load side.

    Torque on the motor; velocity of the motor (resolver) and of the load (gyro), rad/s. The poles are
    -120.2 +- 1343j, -4.930 and 0 1/s; the last is the free rotation, which velocities do not show.
    """
    return _two_inertia_drive(
        (0.0053, 0.18), (9365.0, 0.0, 0.0), (0.8268, 0.4352, 0.4782), Tolerance(), "rig"
    )


def rig_model_nominal() -> LumpedModel:
    """The rig as its builder knows it before the test: wrong numbers, and how wrong they may be.

    The motor lacks the gearbox's share of inertia, the stiffness is a catalogue value, the damping a guess.
    """
    return _two_inertia_drive(
        (0.004, 0.18), (8000.0, 0.0, 0.0), (0.5, 0.3, 0.3), Tolerance(0.3, 0.2, 0.6), "rig, nominal"
    )


def _two_inertia_drive(
    inertia: tuple[float, ...],
    stiffness: tuple[float, ...],
    damping: tuple[float, ...],
    tolerance: Tolerance,
    name: str,
) -> LumpedModel:
    return lumped_model(
        ["motor", "load"],
        inertia,
        stiffness,
        damping,
        connections=RIG_CONNECTIONS,
        inputs=RIG_INPUTS,
        sensors=RIG_SENSORS,
        tolerance=tolerance,
        name=name,
    )
