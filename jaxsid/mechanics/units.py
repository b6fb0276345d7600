"""Units of the axes and tables: SI, for bodies that move or turn, both where the model does not tell."""

from typing import NamedTuple

from jaxsid.mechanics.lumped import LumpedModel

# A model file holds masses or inertias alike; the names of its channels often tell which.
ROTATION = ("torque", "moment", "gyro", "angle", "angular", "encoder", "tacho")
TRANSLATION = ("force", "shaker", "hammer", "acc", "laser", "lvdt", "thrust")
SYMBOLS = {
    "displacement": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s²", "rad/s²"),
    "force": ("N", "N m"),
    "displacement per force": ("m/N", "rad/(N m)"),
    "velocity per force": ("m/s/N", "rad/s/(N m)"),
    "acceleration per force": ("m/s²/N", "rad/s²/(N m)"),
    "mass": ("kg", "kg m²"),
    "damping": ("N s/m", "N m s/rad"),
    "stiffness": ("N/m", "N m/rad"),
}
TURNING_NAMES = {"force": "torque", "displacement": "angle", "mass": "inertia"}


class Units(NamedTuple):
    """Which of the two kinds of motion the numbers are of; None where unknown."""

    turning: bool | None

    def symbol(self, quantity: str) -> str:
        straight, turning = SYMBOLS[quantity]
        if self.turning is None:
            return f"{straight} or {turning}"
        return turning if self.turning else straight

    def name(self, quantity: str) -> str:
        """What the quantity is called: a torque where bodies turn."""
        return TURNING_NAMES.get(quantity, quantity) if self.turning else quantity

    def label(self, quantity: str) -> str:
        """Label of an axis."""
        if not quantity.endswith(" per force"):
            return f"{self.name(quantity)} ({self.symbol(quantity)})"
        kind = quantity.removesuffix(" per force")
        break_or_space = "\n" if self.turning is None else " "
        return f"{self.name(kind)} / {self.name('force')}{break_or_space}({self.symbol(quantity)})"


def units_of(model: LumpedModel) -> Units:
    """Rotation or translation where the names of the inputs, or else of the sensors, agree on one."""
    for channels in (model.inputs, model.sensors):
        names = [channel.name.lower() for channel in channels]
        turning = any(word in name for name in names for word in ROTATION)
        straight = any(word in name for name in names for word in TRANSLATION)
        if turning != straight:
            return Units(turning)
    return Units(None)


def sensor_kinds(model: LumpedModel, outputs: tuple[str, ...]) -> tuple[str, ...]:
    """Kind of each named output."""
    kinds = {sensor.name: sensor.kind for sensor in model.sensors}
    return tuple(kinds[name] for name in outputs)
