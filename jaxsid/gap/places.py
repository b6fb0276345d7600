"""Places where an unmodelled effect may act: between two ends, at a sensor, at an input."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsid.mechanics.lumped import GROUND, LumpedModel

MOST_PAIRS = 36  # beyond these, pairs that nothing joins and that have no neighbour in common are left out


class Place(NamedTuple):
    """One place.

    Attributes:
        where: "between", "sensor" or "input".
        ends: two bodies, or "ground" and a body; or the one name of the sensor or input.
    """

    where: str
    ends: tuple[str, ...]

    @property
    def label(self) -> str:
        return " - ".join(self.ends) if self.where == "between" else f"{self.where} {self.ends[0]}"

    def as_dict(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {self.where: list(self.ends) if self.where == "between" else self.ends[0]}


def places_of(model: LumpedModel) -> tuple[Place, ...]:
    """All pairs of ends, joined ones first, then sensors and inputs.

    A force on one body, whatever its law, is a place between the ground and that body. Of large models those pairs
    are left out that nothing joins and that have no common neighbour.

    Args:
        model: names the bodies, connections, sensors and inputs.
    """
    ends = (GROUND, *model.bodies)
    joined = list(dict.fromkeys(_sorted(c.between, ends) for c in model.connections))
    joined += [pair for pair in _coupled(model, ends) if pair not in joined]
    grounded = [(GROUND, body) for body in model.bodies]
    others = [(a, b) for i, a in enumerate(model.bodies) for b in model.bodies[i + 1 :]]
    if len(others) + len(grounded) > MOST_PAIRS:
        near = {end: {x for pair in joined if end in pair for x in pair} for end in model.bodies}
        others = [(a, b) for a, b in others if (near[a] & near[b]) - {GROUND}]
    pairs = dict.fromkeys([*joined, *grounded, *others])
    return (
        *(Place("between", pair) for pair in pairs),
        *(Place("sensor", (s.name,)) for s in model.sensors),
        *(Place("input", (i.name,)) for i in model.inputs),
    )


def _sorted(between: tuple[str, str], ends: tuple[str, ...]) -> tuple[str, str]:
    a, b = sorted(between, key=ends.index)
    return a, b


def _coupled(model: LumpedModel, ends: tuple[str, ...]) -> list[tuple[str, str]]:
    """Pairs that the entries of given matrices join."""
    if model.matrices is None:
        return []
    K = np.asarray(model.matrices.stiffness)
    scale = np.abs(np.diag(K)).max(initial=0.0)
    grounded = [(GROUND, ends[i + 1]) for i in range(len(K)) if abs(K[i].sum()) > 1e-9 * scale]
    at = np.argwhere(np.abs(np.triu(K, 1)) > 1e-12 * scale)
    return grounded + [(ends[i + 1], ends[j + 1]) for i, j in at]


def joint_of(model: LumpedModel, place: Place) -> Float[np.ndarray, " N"]:
    """-1 at the first end and +1 at the second, so that d = joint' q; the driven body's for an input, else zeros.

    Args:
        model: names the bodies.
        place: one of `places_of`.
    """
    joint = np.zeros(len(model.bodies))
    if place.where == "between":
        for end, sign in zip(place.ends, (-1.0, 1.0), strict=True):
            if end != GROUND:
                joint[model.bodies.index(end)] = sign
    elif place.where == "input":
        (body,) = (i.body for i in model.inputs if i.name == place.ends[0])
        joint[model.bodies.index(body)] = 1.0
    return joint
