"""What the sensors of a true system show: signals in, through the plant, and out as they are recorded.

The input that is recorded is what the controller or the generator asks for; gain, clipping and delay act on it on the
way, so do gain, offset and delay of a sensor on its reading. Imports numpy and scipy only.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from laws import FRICTION, KINKED
from plant import HELD, plant
from stepping import Stepper
from systems import Effect, System, frequencies

STEPS = {  # of a sample, at least, by the kind of effect
    **dict.fromkeys(FRICTION, 16),
    **dict.fromkeys(KINKED, 16),
    "hysteresis": 8,
    "iwan": 12,
    "lugre": 48,
    "hertz_contact": 12,
    **dict.fromkeys(("displacement_damping", "one_sided_damping", "fifth_order_stiffness"), 16),
    "switching_stiffness": 12,
    "impacts": 40,
    "input_delay": 20,
    "sensor_delay": 20,
}
FASTEST = 0.6  # of the fastest mode in a step of smooth laws, rad


class Loop(NamedTuple):
    """Feedback of one noisy sensor: u = reference - gain y - rate_gain (y - last y) / dt."""

    sensor: int
    gain: float
    rate_gain: float


class Motion(NamedTuple):
    """A record without noise: input as recorded (samples,), readings (samples, sensors)."""

    u: np.ndarray
    y: np.ndarray


def steps_of(system: System, effects: tuple[Effect, ...]) -> int:
    """Steps of a sample that do for most cases; none are needed where all is linear.

    Args:
        system: gives the fastest mode.
        effects: give what acts.
    """
    made = plant(system, effects, 0.0)
    at_least = max((STEPS.get(e.kind, 1) for e in effects), default=1)
    if not (made.ports or made.contacts or made.impacts):
        return at_least
    fastest = frequencies(system)[-1:] * system.dt / FASTEST
    stiff = max((e.parameters.get("stiffness", 0.0) for e in effects if e.kind == "end_stop"), default=0.0)
    lightest = min(system.mass)
    contact = np.sqrt(stiff / lightest) * system.dt / FASTEST
    return max(at_least, 3, int(np.ceil(max([*fastest, contact]) * max(1, at_least / 8))))


class _Signals(NamedTuple):
    """What happens to signals: on-grid delays in steps, gain and limit of the input; gains and offsets of outputs."""

    input_gain: float
    limit: float
    input_late: int
    gains: np.ndarray
    offsets: np.ndarray
    late: dict[int, int]


def _signals(system: System, effects: tuple[Effect, ...], h: float) -> _Signals:
    names = [s.name for s in system.sensors]
    gain, limit, input_late = 1.0, np.inf, 0
    gains, offsets, late = np.ones(len(names)), np.zeros(len(names)), {}
    for effect in effects:
        p = effect.parameters
        at = names.index(effect.ends[0]) if effect.where == "sensor" else 0
        if effect.kind == "input_gain":
            gain = p["factor"]
        elif effect.kind == "actuator_saturation":
            limit = p["limit"]
        elif effect.kind == "input_delay":
            input_late = round(p["delay"] / h)
        elif effect.kind == "sensor_gain":
            gains[at] = p["factor"]
        elif effect.kind == "sensor_bias":
            offsets[at] = p["offset"]
        elif effect.kind == "sensor_delay":
            late[at] = round(p["delay"] / h)
    return _Signals(gain, limit, input_late, gains, offsets, late)


class _Bench:
    """The experiment as it goes on, a sample at a time."""

    def __init__(self, system: System, effects: tuple[Effect, ...], steps: int, before: int) -> None:
        made = plant(system, effects, before * system.dt)
        self.dt, self.steps, self.before = system.dt, steps, before
        self.stepper = Stepper(made, system.dt / steps)
        self.signals = _signals(system, effects, system.dt / steps)
        self.x = made.start.copy()
        # where all is linear and nothing is late, a sample is one step
        back, self.part = divmod(self.signals.input_late, steps)
        self.inputs = deque([0.0] * (back + 2), maxlen=back + 2)
        self.w = np.array([0.0, 1.0, 0.0])[:HELD]
        longest = max([0, *(-(-late // steps) for late in self.signals.late.values())])
        self.late = {at: deque([0.0] * (longest + 1), maxlen=longest + 1) for at in self.signals.late}

    def shown(self, k: int, column: int) -> float:
        """A reading that does not see the input of this instant."""
        return float(self._outward(self.stepper.readings(self._time(k), self.x, self.w))[column])

    def _time(self, k: int) -> float:
        return (k - self.before) * self.dt

    def _outward(self, y: np.ndarray) -> np.ndarray:
        y = y.copy()
        for at, late in self.signals.late.items():
            back, part = divmod(late, self.steps)
            if part:
                y[at] = self.late[at][-1 - back]
            elif back:
                y[at] = self.late[at][-back]
        return y * self.signals.gains + self.signals.offsets

    def sample(self, k: int, u: float, disturbance: float) -> np.ndarray:
        """Readings at sample k, then the motion to the next.

        Args:
            k: counted from the beginning of the motion.
            u: input as asked for.
            disturbance: as it acts until the next.
        """
        s, stepper, t = self.signals, self.stepper, self._time(k)
        self.inputs.append(min(max(s.input_gain * u, -s.limit), s.limit))
        older, newer = self.inputs[0], self.inputs[1]
        self.w[0], self.w[2] = older if self.part else newer, disturbance
        plain = stepper.readings(t, self.x, self.w)
        seen = self._outward(plain)
        whole = {at for at, late in s.late.items() if late % self.steps == 0}
        for at in whole:
            self.late[at].append(plain[at])
        for i in range(self.steps):
            if i == self.part:
                self.w[0] = newer
            for at, late in s.late.items():
                if at not in whole and i == self.steps - late % self.steps:
                    self.late[at].append(stepper.readings(t + i * stepper.h, self.x, self.w)[at])
            self.x = stepper.step(t + i * stepper.h, self.x, self.w)
        return seen


def respond(
    system: System,
    effects: tuple[Effect, ...],
    drive: np.ndarray,
    *,
    before: int = 0,
    steps: int = 0,
    loop: Loop | None = None,
    noise: np.ndarray | None = None,
    disturbance: np.ndarray | None = None,
) -> Motion:
    """The motion from rest under an input that is held between samples.

    Args:
        system: true elements.
        effects: what is beyond them.
        drive: (before + samples,), the input; the loop's reference where there is one.
        before: samples of motion ahead of the record's start.
        steps: of a sample; 0 chooses.
        loop: feedback.
        noise: (before + samples,) of the loop's sensor.
        disturbance: (before + samples,) of unit rms, for a random force.

    Returns:
        Motion from its beginning, ahead of the record's start, without noise.
    """
    steps = steps or steps_of(system, effects)
    bench = _Bench(system, effects, steps, before)
    u, y, last = np.zeros(len(drive)), np.zeros((len(drive), len(system.sensors))), 0.0
    for k, reference in enumerate(drive):
        u[k] = reference
        if loop is not None:
            seen = bench.shown(k, loop.sensor) + (0.0 if noise is None else noise[k])
            u[k] -= loop.gain * seen + loop.rate_gain * (seen - last) / system.dt
            last = seen
        y[k] = bench.sample(k, u[k], 0.0 if disturbance is None else disturbance[k])
    return Motion(u, y)
