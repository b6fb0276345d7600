"""A step in which dry friction changes sign: to the instant of rest, and on from there as the contact decides."""

import numpy as np
from plant import Plant

MOST = 12  # instants of rest in one step
STILL = 1e-10  # relative speed, next to the largest so far, below which a contact is at rest


def resting(W: np.ndarray, free: np.ndarray, levels: list[float], first: np.ndarray) -> np.ndarray:
    """Forces r within their limits with W r + free = 0 where none is at its limit.

    Args:
        W: gains, negative on the diagonal.
        free: without forces.
        levels: limits.
        first: where to start.
    """
    r = first.copy()
    for _ in range(1 if len(r) == 1 else 50):
        last = r.copy()
        for i, level in enumerate(levels):
            alone = -(free[i] + W[i] @ r - W[i, i] * r[i]) / W[i, i]
            r[i] = min(max(alone, -level), level)
        if np.abs(r - last).max() <= 1e-12 * max(levels):
            break
    return r


class Reversals:
    """Motion of a plant whose contacts slide one way (+1, -1) or rest (0)."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.J = np.array([x.row for x in plant.contacts])
        self.G = np.stack([x.column for x in plant.contacts], axis=1)
        self.JG = self.J @ self.G

    def levels(self, x: np.ndarray) -> list[float]:
        """Of friction, at the speeds of a state."""
        speeds = (self.J @ x).tolist()
        return [c.level(abs(s)) for c, s in zip(self.plant.contacts, speeds, strict=True)]

    def smooth(self, t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Rate of the state without friction."""
        rate = self.plant.A @ x + self.plant.B @ w
        for port in self.plant.ports:
            a, b = (port.rows @ x).tolist()
            rate = rate + port.column * port.law(t, a, b)
        return rate

    def friction(self, rate: np.ndarray, x: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Forces: of contacts that slide, and of those that rest as much as keeps them there."""
        levels = self.levels(x)
        sliding = ways * levels
        if ways.all():
            return sliding
        limits = [0.0 if way else level for way, level in zip(ways, levels, strict=True)]
        return sliding + resting(self.JG, self.J @ (rate + self.G @ sliding), limits, 0 * sliding)

    def rate(self, t: float, x: np.ndarray, w: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Of the state."""
        smooth = self.smooth(t, x, w)
        return smooth + self.G @ self.friction(smooth, x, ways)

    def flow(self, t: float, x: np.ndarray, w: np.ndarray, ways: np.ndarray, h: float) -> np.ndarray:
        """A step of the classical fourth-order method."""
        a = self.rate(t, x, w, ways)
        b = self.rate(t + h / 2, x + h / 2 * a, w, ways)
        c = self.rate(t + h / 2, x + h / 2 * b, w, ways)
        d = self.rate(t + h, x + h * c, w, ways)
        return x + h / 6 * (a + 2 * b + 2 * c + d)

    def decided(self, t: float, x: np.ndarray, w: np.ndarray, ways: np.ndarray, at: int) -> np.ndarray:
        """Where a contact goes that has come to rest: on at its limit, or nowhere."""
        ways = ways.copy()
        ways[at] = 0
        force, level = self.friction(self.smooth(t, x, w), x, ways)[at], self.levels(x)[at]
        ways[at] = np.sign(force) if abs(force) >= level * (1 - 1e-12) else 0
        return ways

    def step(self, t: float, x: np.ndarray, w: np.ndarray, h: float, fastest: float) -> np.ndarray | None:
        """The state h later; None where contacts reverse too often.

        Args:
            t: s from the record's start.
            x: state.
            w: held input.
            h: step.
            fastest: relative speed so far, in which rest is measured.
        """
        speeds = self.J @ x
        ways = np.where(np.abs(speeds) < STILL * fastest, 0.0, np.sign(speeds))
        for at in np.flatnonzero(ways == 0):
            ways = self.decided(t, x, w, ways, int(at))
        for _ in range(MOST):
            after = self.flow(t, x, w, ways, h)
            wrong = np.flatnonzero(ways * (self.J @ after) < 0)
            if not len(wrong):
                return after
            found = [(self._rest(t, x, w, ways, h, int(i)), int(i)) for i in wrong]
            part, at = min(found)
            x = self.flow(t, x, w, ways, part)
            t, h = t + part, h - part
            x = x - self.G[:, at] * (self.J[at] @ x) / self.JG[at, at]
            ways = self.decided(t, x, w, ways, at)
        return None

    def _rest(self, t: float, x: np.ndarray, w: np.ndarray, ways: np.ndarray, h: float, at: int) -> float:
        """When a contact's speed passes through zero, by false position with one end halved (Illinois)."""
        speed = lambda part: float(self.J[at] @ self.flow(t, x, w, ways, part)) * ways[at]  # noqa: E731
        a, b, fa, fb = 0.0, h, float(self.J[at] @ x) * ways[at], speed(h)
        if fa <= 0:
            return 0.0
        for _ in range(20):
            c = (a * fb - b * fa) / (fb - fa)
            fc = speed(c)
            if abs(fc) < 1e-12 * fa or b - a < 1e-12 * h:
                break
            if fc * fb < 0:
                a, fa = b, fb
            else:
                fa /= 2
            b, fb = c, fc
        return min(max(c, 0.0), h)
