"""One step of x' = A x + B w + E f(t, x) + G r with w held: the linear part exact, the laws to fourth order.

Dry friction r is a force that is held over a step and keeps the relative speed zero at its end or is at its limit, so
that rest is rest. Steps in which it would change sign are left to `reversals`. A rigid stop turns the speed over at the
instant at which the gap closes.

Source: S. Cox and P. Matthews, J. Comput. Phys. 176 (2002); J. Moreau, Comput. Methods Appl. Mech. Engrg. 177 (1999).
"""

import numpy as np
import scipy.linalg
from laws import Iwan
from plant import HELD, Impact, Plant
from reversals import STILL, Reversals, resting


def _phis(A: np.ndarray, E: np.ndarray, h: float) -> list[np.ndarray]:
    """exp(A h), h phi1 E, h phi2 E, h phi3 E."""
    n, m = E.shape
    size = n + 3 * m
    big = np.zeros((size, size))
    big[:n, :n], big[:n, n : n + m] = A * h, E * h
    big[n : size - m, n + m :] = np.eye(2 * m)
    full = scipy.linalg.expm(big)[:n]
    return [full[:, :n], *(full[:, n + i * m : n + (i + 1) * m] for i in range(3))]


class Stepper:
    """Goes from one end of a step to the next; it keeps friction forces and the memory of laws."""

    def __init__(self, plant: Plant, h: float) -> None:
        self.plant, self.h = plant, h
        self.p, self.c = len(plant.ports), len(plant.contacts)
        n = len(plant.A)
        E = np.stack([x.column for x in plant.ports], axis=1) if self.p else np.zeros((n, 0))
        G = np.stack([x.column for x in plant.contacts], axis=1) if self.c else np.zeros((n, 0))
        held = np.hstack([plant.B, G])
        R = np.concatenate([x.rows for x in plant.ports]) if self.p else np.zeros((0, n))
        F, whole, *_ = _phis(plant.A, held, h)
        half, toward, *_ = _phis(plant.A, held, h / 2)
        one, two, three = _phis(plant.A, E, h)[1:]
        short = _phis(plant.A, E, h / 2)[1]
        self.n, self.through = n, G
        self.rub_gain = whole[:, HELD:]
        base = np.hstack([F, whole])
        self.Z = np.concatenate(
            [base, np.pad(R, ((0, 0), (0, HELD + self.c))), R @ np.hstack([half, toward]), R @ base]
        )
        self.weights = np.hstack([one - 3 * two + 4 * three, 2 * two - 4 * three, 4 * three - two])
        self.mid = (R @ short).tolist()
        self.late = (R @ half @ short).tolist()
        self.laws = [x.law for x in plant.ports]
        self.J = np.array([x.row for x in plant.contacts]).reshape(self.c, n)
        self.W = self.J @ self.rub_gain
        self.rub, self.last, self.fastest = np.zeros(self.c), np.zeros(self.c), 1e-300
        self.reversals = Reversals(plant) if self.c else None
        self.memories = [(i, x.law) for i, x in enumerate(plant.ports) if isinstance(x.law, Iwan)]

    def forces(self, t: float, q: list[float]) -> list[float]:
        """Of all laws at given displacements and velocities."""
        return [law(t, q[2 * i], q[2 * i + 1]) for i, law in enumerate(self.laws)]

    def step(self, t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """The state h later.

        Args:
            t: s from the record's start.
            x: state.
            w: held input.
        """
        n, k = self.n, 2 * self.p
        all_of_it = self.Z @ np.concatenate([x, w, self.rub])
        after = all_of_it[:n]
        if self.p == 1:
            after = after + self.weights @ self._one(t, all_of_it[n:].tolist())
        elif self.p:
            after = after + self.weights @ self._several(t, all_of_it[n:].tolist(), k)
        if self.reversals is not None:
            after = self._rubbed(self.reversals, t, x, w, after)
        for stop in self.plant.impacts:
            after = self._struck(x, after, stop)
        for i, law in self.memories:
            law.commit(float(self.plant.ports[i].rows[0] @ after))
        return after

    def _one(self, t: float, q: list[float]) -> tuple[float, float, float]:
        """Stages for a single law, written out because they take most of the time."""
        law, h = self.laws[0], self.h
        (a,), (b,) = self.mid
        (c,), (d,) = self.late
        f1 = law(t, q[0], q[1])
        f2 = law(t + h / 2, q[2] + a * f1, q[3] + b * f1)
        f3 = law(t + h / 2, q[2] + a * f2, q[3] + b * f2)
        g = 2 * f3 - f1
        f4 = law(t + h, q[4] + c * f1 + a * g, q[5] + d * f1 + b * g)
        return f1, f2 + f3, f4

    def _several(self, t: float, q: list[float], k: int) -> np.ndarray:
        mid, late, now = np.array(self.mid), np.array(self.late), np.array(q)
        f1 = np.array(self.forces(t, q[:k]))
        f2 = np.array(self.forces(t + self.h / 2, (now[k : 2 * k] + mid @ f1).tolist()))
        f3 = np.array(self.forces(t + self.h / 2, (now[k : 2 * k] + mid @ f2).tolist()))
        end = now[2 * k :] + late @ f1 + mid @ (2 * f3 - f1)
        f4 = np.array(self.forces(t + self.h, end.tolist()))
        return np.concatenate([f1, f2 + f3, f4])

    def _rubbed(
        self, reversals: Reversals, t: float, x: np.ndarray, w: np.ndarray, after: np.ndarray
    ) -> np.ndarray:
        """The step's end with friction; contacts in turns until they agree."""
        speeds = self.J @ x
        self.fastest = max(self.fastest, float(np.abs(speeds).max()))
        still = np.abs(speeds) < STILL * self.fastest
        # the level in mid-step, from how the speed changed before; of what rests the level at rest
        ahead = np.where(still, 0.0, 1.5 * speeds - 0.5 * self.last)
        levels = [c.level(abs(s)) for c, s in zip(self.plant.contacts, ahead.tolist(), strict=True)]
        found = resting(self.W, self.J @ after - self.W @ self.rub, levels, self.rub)
        self.last = speeds
        if np.any(~still & (found * np.sign(speeds) < np.array(levels) * (1 - 1e-9))):
            exact = reversals.step(t, x, w, self.h, self.fastest)
            if exact is not None:
                self.last = self.J @ exact
                return exact
        after = after + self.rub_gain @ (found - self.rub)
        self.rub = found
        return after

    def _struck(self, before: np.ndarray, after: np.ndarray, stop: Impact) -> np.ndarray:
        """After a collision within the step, the rest of the step being made with the speed after it."""
        (d0, v0), (d, v) = stop.rows @ before, stop.rows @ after
        if d <= stop.gap or v <= 0:
            return after
        way, gain = stop.gap - d0, (v - v0) / self.h
        root = np.sqrt(max(v0**2 + 2 * gain * way, 0.0))
        taken = min(max(2 * way / max(v0 + root, 1e-300), 0.0), self.h)
        left = self.h - taken
        jump = -(1 + stop.restitution) * (v - gain * left)
        return after + jump * stop.column + left * jump * stop.shift

    def readings(self, t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """What ideal sensors show at an instant.

        Args:
            t: s from the record's start.
            x: state.
            w: held input from now on.
        """
        plant = self.plant
        y = plant.C @ x + plant.D @ w
        q = [plant.ports[i].rows @ x for i in range(self.p)]
        forces = [law(t, float(d), float(v)) for law, (d, v) in zip(self.laws, q, strict=True)]
        for port, f in zip(plant.ports, forces, strict=True):
            y = y + port.through * f
        if self.reversals is None:
            return y
        speeds = self.J @ x
        ways = np.where(np.abs(speeds) < STILL * self.fastest, 0.0, np.sign(speeds))
        rate = self.reversals.smooth(t, x, w)
        for contact, force in zip(plant.contacts, self.reversals.friction(rate, x, ways), strict=True):
            y = y + contact.through * force
        return y
