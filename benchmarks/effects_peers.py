"""What a user of scipy would write for a chain with one effect: `solve_ivp` on a right-hand side of few numpy calls.

The linear part and the effect's place are taken from the tests' truth by trying unit states. Dry friction is
either smoothed, tanh(v / scale), or runs from event to event.
"""

import copy
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from effects_cases import DT, Case, error, truth_of
from scipy.integrate import solve_ivp

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10)
LAWS = (
    "quadratic_damping",
    "cubic_stiffness",
    "quadratic_stiffness",
    "bilinear_stiffness",
    "backlash",
    "end_stop",
    "cogging_ripple",
    "time_varying_stiffness",
)
SMOOTHINGS = (1e-3, 1e-5)  # m/s, of some 0.1 m/s
LONGEST = 4.0  # s of a trial


class Setting(NamedTuple):
    method: str
    how: str  # "whole" record at once, "by sample", "by event"
    tolerance: float
    smoothing: float = 0.0

    def __str__(self) -> str:
        smooth = f", tanh {self.smoothing:g} m/s" if self.smoothing else ""
        return f"{self.method} {self.how}, rtol {self.tolerance:g}{smooth}"


class Peer:
    """x' = A x + B u(t) - g F, with F the effect's law; readings at the samples."""

    def __init__(self, case: Case, u: np.ndarray):
        self.case, self.truth = case, truth_of(case)
        t, p = self.truth, case.parameters
        self.N, self.rubs = t.N, "friction" in case.kind
        late = p.get("delay", 0.0)
        self.late_input = late if case.kind == "input_delay" else 0.0
        self.late_sensor = late if case.kind == "sensor_delay" else 0.0
        self.held = np.clip(u, -p["limit"], p["limit"]) if case.kind == "actuator_saturation" else u
        still = copy.copy(t)
        still.law = lambda t, x: 0.0
        still.p = dict(p) | dict.fromkeys(p.keys() & {"beta", "gamma", "amplitude", "delay"}, 0.0)
        if case.kind == "actuator_saturation":
            still.p["limit"] = np.inf
        still.u = np.array([0.0])
        zero = np.zeros_like(t.x)
        self.load = still.smooth(0.0, zero, 0)
        self.A = np.stack([still.smooth(0.0, x, 0) - self.load for x in np.eye(len(zero))], axis=1)
        still.u = np.array([1.0])
        self.B = still.smooth(0.0, zero, 0) - self.load
        self.g = np.zeros_like(zero)
        self.g[self.N : 2 * self.N] = t.inverse @ t.e
        if case.kind == "periodic_disturbance":
            self.g[self.N : 2 * self.N] = -t.inverse[:, case.place]
        self.law = self._law()

    def _law(self):
        """The force from time and state; None where all is linear."""
        kind, p, N = self.case.kind, self.case.parameters, self.N
        if kind == "periodic_disturbance":
            w = 2 * np.pi * p["frequency_hz"]
            return lambda t, x: p["amplitude"] * np.sin(w * t + p["phase"])
        if kind == "hysteresis":
            return lambda t, x: p["stiffness"] * x[2 * N]
        return self.truth.law if kind in LAWS else None

    def input_at(self, t: float) -> float:
        k = int((t - self.late_input) / DT + 1e-9)
        return 0.0 if t < self.late_input - 1e-12 else self.held[min(k, len(self.held) - 1)]

    def smooth(self, t: float, x: np.ndarray, u: float) -> np.ndarray:
        dx = self.A @ x + self.B * u + self.load
        if self.law is not None:
            dx -= self.g * self.law(t, x)
        if self.case.kind == "hysteresis":
            p, z, w = self.case.parameters, x[-1], dx[-1]
            size = abs(z) ** p["exponent"]
            dx[-1] -= (p["beta"] * abs(w) * np.sign(z) + p["gamma"] * w) * size
        return dx

    def right_hand_side(self, smoothing: float):
        e, N, level = self.truth.e, self.N, self.truth.level
        if not self.rubs:
            return lambda t, x: self.smooth(t, x, self.input_at(t))

        def rubbing(t: float, x: np.ndarray) -> np.ndarray:
            v = e @ x[N : 2 * N]
            return self.smooth(t, x, self.input_at(t)) - self.g * (level(abs(v)) * np.tanh(v / smoothing))

        return rubbing

    def run(self, setting: Setting, samples: int) -> tuple[float, np.ndarray]:
        """Processor seconds, without the readings, and readings at the samples."""
        at = np.arange(samples) * DT
        if self.late_sensor:
            at = np.union1d(at, np.maximum(at - self.late_sensor, 0.0))
        begin = time.process_time()
        how = {"whole": self._whole, "by sample": self._by_sample, "by event": self._by_event}[setting.how]
        states, ways = how(setting, at)
        return time.process_time() - begin, self._readings(setting, at, states, ways, samples)

    def _options(self, setting: Setting) -> dict:
        return {"method": setting.method, "rtol": setting.tolerance, "atol": 1e-3 * setting.tolerance}

    def _whole(self, setting: Setting, at: np.ndarray) -> tuple[np.ndarray, None]:
        found = solve_ivp(
            self.right_hand_side(setting.smoothing),
            (0.0, at[-1]),
            self.truth.x,
            t_eval=at,
            **self._options(setting),
        )
        return found.y.T, None

    def _by_sample(self, setting: Setting, at: np.ndarray) -> tuple[np.ndarray, None]:
        """From one instant at which the input changes to the next, in one step where that is exact enough."""
        jumps = np.arange(round(at[-1] / DT)) * DT + self.late_input % DT
        stops = np.union1d(np.round(at, 12), np.round(jumps, 12))
        x, states = self.truth.x, [self.truth.x]
        for t, end in pairwise(stops):
            u = self.input_at(t + 1e-9)
            run = solve_ivp(
                lambda s, x, u=u: self.smooth(s, x, u),
                (t, end),
                x,
                first_step=end - t,
                **self._options(setting),
            )
            x = run.y[:, -1]
            states.append(x)
        return np.array(states)[np.searchsorted(stops, at - 1e-9)], None

    def _by_event(self, setting: Setting, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sliding until the speed is zero, resting until the balancing force is more than friction's."""
        e, N, level, truth = self.truth.e, self.N, self.truth.level, self.truth

        def needed(t: float, x: np.ndarray) -> float:
            return e @ self.smooth(t, x, self.input_at(t))[N : 2 * N] / truth.W

        def slide(t: float, x: np.ndarray) -> np.ndarray:
            return self.smooth(t, x, self.input_at(t)) - self.g * (way * level(abs(e @ x[N : 2 * N])))

        def rest(t: float, x: np.ndarray) -> np.ndarray:
            dx = self.smooth(t, x, self.input_at(t))
            return dx - self.g * (e @ dx[N : 2 * N] / truth.W)

        stops = lambda t, x: way * (e @ x[N : 2 * N])  # noqa: E731
        slips = lambda t, x: level(0.0) - abs(needed(t, x))  # noqa: E731
        for event in (stops, slips):
            event.terminal, event.direction = True, -1
        t, x, end, way = 0.0, truth.x, at[-1], 0
        states, ways = np.tile(x, (len(at), 1)), np.zeros(len(at))
        while t < end - 1e-12:
            force = needed(t, x)
            if not way and abs(force) > level(0.0):
                way = int(np.sign(force))
                x = x + 1e-7 * slide(t, x)  # off the event's own zero
                t += 1e-7
            inside = (at >= t - 1e-12) & (at <= end)
            run = solve_ivp(
                slide if way else rest,
                (t, end),
                x,
                t_eval=at[inside],
                events=stops if way else slips,
                **self._options(setting),
            )
            first = len(at) - inside.sum()
            if len(run.t):
                states[first : first + len(run.t)], ways[first : first + len(run.t)] = run.y.T, way
            if run.status != 1:
                break
            t, x = run.t_events[0][0], run.y_events[0][0].copy()
            states[first + len(run.t) :] = x  # what falls between the event and where the next part begins
            if way:
                x[N : 2 * N] -= truth.inverse @ e * (e @ x[N : 2 * N]) / truth.W
                way = 0
            else:
                way = int(np.sign(needed(t, x)))
                x, t = x + 1e-7 * slide(t, x), t + 1e-7
        return states, ways

    def _readings(
        self, setting: Setting, at: np.ndarray, states: np.ndarray, ways: np.ndarray | None, samples: int
    ) -> np.ndarray:
        if len(states) < len(at):
            return np.full((samples, len(self.truth.chain.sensors)), np.nan)
        truth, N, whole = self.truth, self.N, self.right_hand_side(setting.smoothing or 1.0)
        y = []
        for i, (t, x) in enumerate(zip(at, states, strict=True)):
            if ways is None:
                a = whole(t, x)[N : 2 * N]
            else:
                truth.u = self.held
                k = int(t / DT + 1e-9)
                a = truth.derivative(t, x, k, int(ways[i]) or truth.decide(t, x, k))[N : 2 * N]
            y.append(truth.ideal(x, a))
        y, exact = np.array(y), np.round(at, 12)
        plain = y[np.searchsorted(exact, np.round(np.arange(samples) * DT, 12) - 1e-9)]
        p, place = self.case.parameters, self.case.place
        if self.case.kind == "sensor_lag":
            plain[:, place] = states[:, 2 * N]
        if self.case.kind == "sensor_gain":
            plain[:, place] *= p["factor"]
        if self.case.kind == "sensor_bias":
            plain[:, place] += p["offset"]
        if self.late_sensor:
            then = np.arange(samples) * DT - self.late_sensor
            late = y[np.searchsorted(exact, np.round(np.maximum(then, 0.0), 12) - 1e-9), place]
            plain[:, place] = np.where(then >= 0, late, 0.0)
        return plain


def ladders(case: Case) -> Iterator[list[Setting]]:
    """Settings to try, each list from coarse to fine; first those that are mostly the fastest."""
    if "friction" in case.kind:
        for method in ("RK45", "LSODA"):
            yield [Setting(method, "by event", x) for x in TOLERANCES[:6]]
        for method in ("LSODA", "Radau"):
            for smoothing in SMOOTHINGS:
                yield [Setting(method, "whole", x, smoothing) for x in TOLERANCES[1:5:2]]
        return
    yield [Setting("RK23", "by sample", 1e-3), Setting("RK45", "by sample", 1e-3)]
    yield [Setting("DOP853", "by sample", x) for x in (1e-3, 1e-6, 1e-10)]
    for method in ("LSODA", "RK45", "DOP853", "Radau"):
        yield [Setting(method, "whole", x) for x in TOLERANCES]


class Trial(NamedTuple):
    setting: Setting
    seconds: float
    error: float


def trials(peer: Peer, truth: np.ndarray, wanted: float) -> list[Trial]:
    """All settings that may be the fastest whose readings err by no more than wanted."""
    found: list[Trial] = []
    for ladder in ladders(peer.case):
        for setting in ladder:
            best = min((x.seconds for x in found if x.error <= wanted), default=LONGEST / 2)
            try:
                with limited(2 * best + 0.05):
                    seconds, y = peer.run(setting, len(truth))
            except TimeoutError:  # finer ones take longer still
                break
            found.append(Trial(setting, seconds, error(y, truth)))
            if found[-1].error <= wanted:
                break
    return found


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """TimeoutError after so much processor time."""

    def stop(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
