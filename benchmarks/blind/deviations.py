"""How far numbers that were found lie from the true ones, in the standard deviations that were said of them.

Of effects that were found with their kind at their place. A wrong number of the model is told relative to the nominal
one, while the true one differs from that within its tolerance, too.
"""

import math
from typing import Any

import numpy as np
from equivalent import answer, system_of
from systems import System

MOST = 3  # standard deviations that are looked at
ERRORS = {"mass_error": "mass", "stiffness_error": "stiffness", "damping_error": "damping"}


def pulls(label: dict[str, Any], found: dict[str, Any]) -> list[float]:
    """Deviations of numbers from the true ones, each over its own standard deviation; angles are left out.

    Args:
        label: of a case.
        found: its diagnosis.
    """
    selected = {answer(e["kind"], e["place"]): e for e in found.get("selected") or []}
    each = []
    for effect in label["effects"]:
        said = selected.get(answer(effect["kind"], effect["place"]))
        if said is None:
            continue
        scale = _of_nominal(label, effect) if effect["kind"] in ERRORS else 1.0
        for name, value in effect["parameters"][0].items():
            x = said["parameters"].get(name)
            if x is None or isinstance(x["value"], list) or name == "phase" or not (x["std"] or 0) > 0:
                continue
            each.append((x["value"] - scale * value) / x["std"])
    return [p for p in each if math.isfinite(p)]


def within(every: list[float]) -> dict[str, Any]:
    """Shares that lie within one, two and three standard deviations.

    Args:
        every: of `pulls`, of all cases.
    """
    sizes = np.abs(every)
    shares = [float(np.mean(sizes < k)) if every else None for k in range(1, MOST + 1)]
    return {"numbers": len(every), "shares": shares}


def _of_nominal(label: dict[str, Any], effect: dict[str, Any]) -> float:
    """The true number before the effect, relative to the nominal one."""
    nominal, true = (_number(system_of(label[x]), effect) for x in ("nominal", "true"))
    return true / nominal if nominal else math.nan


def _number(system: System, effect: dict[str, Any]) -> float:
    what, (ends,) = ERRORS[effect["kind"]], effect["place"].values()
    if what == "mass":
        return system.mass[system.bodies.index(ends)]
    return sum(getattr(c, what) for c in system.connections if set(c.between) == set(ends))
