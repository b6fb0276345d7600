"""Reference motion of a chain with one effect, by scipy's adaptive integration from event to event.

Written from the definitions of the effects, not from the library: friction is a sign with a state of rest, inputs are
cut at every sample, delays at the instants at which late samples arrive.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

GROUND = -1


class Chain(NamedTuple):
    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    driven: int  # body that the force acts on
    sensors: tuple  # (body, kind)


class Truth:
    """The motion of a chain with one effect under a held force, from rest."""

    def __init__(self, chain, kind, place, parameters, dt, hold="zero"):
        self.chain, self.kind, self.place, self.p = chain, kind, place, parameters
        self.dt, self.hold = dt, hold
        self.M, self.D, self.K = (np.array(x, float) for x in chain[:3])
        self.N = len(self.M)
        self.e = np.zeros(self.N)
        if isinstance(place, tuple):
            for end, sign in zip(place, (-1.0, 1.0), strict=True):
                if end != GROUND:
                    self.e[end] = sign
        self.way = None  # of dry friction: +1, -1 sliding, 0 resting
        self._linear_changes()
        self.inverse = np.linalg.inv(self.M)
        self.W = self.e @ self.inverse @ self.e
        self.gives = kind == "stribeck_friction" and "stiffness" in parameters
        extra = {"missing_mode": 2, "hysteresis": 1, "sensor_lag": 1, "actuator_lag": 1}.get(kind, self.gives)
        self.x = np.zeros(2 * self.N + extra)

    def _linear_changes(self):
        kind, p, e = self.kind, self.p, self.e
        across = np.outer(e, e)
        if kind == "mass_error":
            self.M[self.place, self.place] *= p["factor"]
        elif kind == "stiffness_error":
            self.K += (p["factor"] - 1) * self._spring(self.K) * across
        elif kind == "damping_error":
            self.D += (p["factor"] - 1) * self._spring(self.D) * across
        elif kind == "missing_connection":
            self.K += p["stiffness"] * across
            self.D += p["damping"] * across

    def _spring(self, matrix):
        a, b = self.place
        return matrix[max(a, b)].sum() if GROUND in (a, b) else -matrix[a, b]

    # what the force is between samples

    def force(self, t, k):
        """Of the drive at t, the newest sample that has arrived being k."""
        u, delay = self.u, self.p["delay"] if self.kind == "input_delay" else 0.0
        past = lambda i: 0.0 if i < 0 else u[min(i, len(u) - 1)]  # noqa: E731
        value = past(k)
        if self.hold == "first":
            value += (past(k + 1) - value) * (t - delay - k * self.dt) / self.dt
        return value * self.p["factor"] if self.kind == "input_gain" else value

    def law(self, t, x):
        """Force across the place, without dry friction."""
        kind, p, N = self.kind, self.p, self.N
        d, v = self.e @ x[:N], self.e @ x[N : 2 * N]
        if kind == "quadratic_damping":
            return p["coefficient"] * abs(v) * v
        if kind == "cubic_stiffness":
            return p["coefficient"] * d**3
        if kind == "quadratic_stiffness":
            return p["coefficient"] * d**2
        if kind == "bilinear_stiffness":
            return p["stiffness"] * d if d > 0 else 0.0
        if kind == "backlash":
            return -self._spring(self.K) * min(max(d, -p["half_gap"]), p["half_gap"])
        if kind == "end_stop":
            b = p["clearance"]
            return p["stiffness"] * (d - b if d > b else d + b if d < -b else 0.0)
        if kind == "hysteresis" or self.gives:
            return p["stiffness"] * x[2 * N]
        if kind == "cogging_ripple":
            return p["amplitude"] * np.sin(p["wavenumber"] * d + p["phase"])
        if kind == "time_varying_stiffness":
            return p["rate"] * t * d
        return 0.0

    def smooth(self, t, x, k):
        """Derivative without dry friction."""
        N, kind, p = self.N, self.kind, self.p
        q, v = x[:N], x[N : 2 * N]
        f = -self.D @ v - self.K @ q - self.e * self.law(t, x)
        extra = np.zeros(len(x) - 2 * N)
        drive = self.force(t, k)
        if kind == "actuator_saturation":
            drive = min(max(drive, -p["limit"]), p["limit"])
        if kind == "actuator_lag":
            extra[0] = (drive - x[2 * N]) / p["time_constant"]
            drive = x[2 * N]
        f[self.chain.driven] += drive
        if kind == "constant_load":
            f[self.place] += p["force"]
        if kind == "periodic_disturbance":
            f[self.place] += p["amplitude"] * np.sin(2 * np.pi * p["frequency_hz"] * t + p["phase"])
        if kind == "missing_mode":
            pull = p["stiffness"] * (x[2 * N] - q[self.place]) + p["damping"] * (x[2 * N + 1] - v[self.place])
            f[self.place] += pull
            extra[:] = x[2 * N + 1], -pull / p["mass"]
        if kind == "hysteresis":
            z, w, n = x[2 * N], self.e @ v, p["exponent"]
            extra[0] = w - p["beta"] * abs(w) * abs(z) ** (n - 1) * z - p["gamma"] * w * abs(z) ** n
        if self.gives:
            w = self.e @ v
            extra[0] = w - p["stiffness"] * abs(w) * x[2 * N] / self.level(w)
        a = self.inverse @ f
        if kind == "sensor_lag":
            extra[0] = (self.ideal(x, a)[self.place] - x[2 * N]) / p["time_constant"]
        return np.concatenate([v, a, extra])

    # dry friction

    def level(self, speed):
        p = self.p
        if self.kind == "coulomb_friction":
            return p["force"]
        return p["force"] + (p["static_force"] - p["force"]) * np.exp(-((speed / p["velocity"]) ** 2))

    def rub(self, t, x, k, way):
        """Dry friction while sliding one way; the balancing force while resting."""
        if way:
            return way * self.level(abs(self.e @ x[self.N : 2 * self.N]))
        return self.e @ self.smooth(t, x, k)[self.N : 2 * self.N] / self.W

    def derivative(self, t, x, k, way):
        dx = self.smooth(t, x, k)
        if way is not None:
            dx[self.N : 2 * self.N] -= self.inverse @ self.e * self.rub(t, x, k, way)
        return dx

    def decide(self, t, x, k):
        """What a contact does whose relative speed is zero."""
        needed = self.rub(t, x, k, 0)
        return 0 if abs(needed) <= self.level(0.0) else int(np.sign(needed))

    def advance(self, t, end, k):
        """To an instant before which nothing new arrives."""
        if end - t < 1e-12:
            return
        options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-14, "first_step": end - t}
        if "friction" not in self.kind or self.gives:
            self.x = solve_ivp(self.derivative, (t, end), self.x, args=(k, None), **options).y[:, -1]
            return
        while end - t > 1e-12:
            if not self.way:
                self.way = self.decide(t, self.x, k)
                if (
                    self.way
                ):  # away from the event's own zero, from which the speed may come back within a step
                    short = min(1e-4 * self.dt, end - t)
                    run = solve_ivp(
                        self.derivative, (t, t + short), self.x, args=(k, self.way), method="DOP853"
                    )
                    t, self.x = t + short, run.y[:, -1]
                    continue
            options["first_step"] = end - t
            stop = lambda s, x, k, way: self.e @ x[self.N : 2 * self.N] * way  # noqa: E731
            slip = lambda s, x, k, way: self.level(0.0) - abs(self.rub(s, x, k, 0))  # noqa: E731
            event = stop if self.way else slip
            event.terminal, event.direction = True, -1
            run = solve_ivp(self.derivative, (t, end), self.x, args=(k, self.way), events=event, **options)
            t, self.x = run.t[-1], run.y[:, -1]
            if run.status == 1:
                if self.way:  # stopped: remove rounding of the speed
                    v = self.x[self.N : 2 * self.N]
                    v -= self.inverse @ self.e * (self.e @ v) / self.W
                    self.way = self.decide(t, self.x, k)
                else:
                    self.way = int(np.sign(self.rub(t, self.x, k, 0)))

    # sensors

    def ideal(self, x, a):
        parts = {"displacement": x[: self.N], "velocity": x[self.N : 2 * self.N], "acceleration": a}
        return np.array([parts[kind][body] for body, kind in self.chain.sensors])

    def readings(self, t, k):
        way = self.way
        if "friction" in self.kind and not self.gives and not way:
            way = self.decide(t, self.x, k)
        y = self.ideal(self.x, self.derivative(t, self.x, k, way)[self.N : 2 * self.N])
        if self.kind == "sensor_lag":
            y[self.place] = self.x[2 * self.N]
        if self.kind == "sensor_gain":
            y[self.place] *= self.p["factor"]
        if self.kind == "sensor_bias":
            y[self.place] += self.p["offset"]
        return y

    def run(self, u):
        """Readings at every sample."""
        self.u, dt = np.asarray(u, float), self.dt
        late = self.p["delay"] if self.kind in ("input_delay", "sensor_delay") else 0.0
        back = int(np.floor(late / dt))
        part = late - back * dt
        if self.kind == "input_delay":
            return self._with_late_input(back, part)
        if self.kind == "sensor_delay":
            return self._with_late_sensor(back, part)
        found = []
        for k in range(len(u)):
            found.append(self.readings(k * dt, k))
            self.advance(k * dt, (k + 1) * dt, k)
        return np.array(found)

    def _with_late_input(self, back, part):
        found, dt = [], self.dt
        for k in range(len(self.u)):
            newest = k - back - 1 if part > 0 else k - back
            found.append(self.readings(k * dt, newest))
            if part > 0:
                self.advance(k * dt, k * dt + part, newest)
            self.advance(k * dt + part, (k + 1) * dt, k - back)
        return np.array(found)

    def _with_late_sensor(self, back, part):
        """The late sensor's reading is that of `part` before a sample, then shifted by whole samples."""
        dt, plain, between = self.dt, [], []
        for k in range(len(self.u)):
            plain.append(self.readings(k * dt, k))
            self.advance(k * dt, (k + 1) * dt - part, k)
            between.append(self.readings((k + 1) * dt - part, k)[self.place])
            if part > 0:
                self.advance((k + 1) * dt - part, (k + 1) * dt, k)
        y = np.array(plain)
        column = np.concatenate([np.zeros(back + 1), between])[: len(y)]
        y[:, self.place] = (
            column if part > 0 else np.concatenate([np.zeros(back), y[:, self.place]])[: len(y)]
        )
        return y
