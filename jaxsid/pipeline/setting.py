"""What the model and the records promise before anything is estimated: sensors, places, visible states."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxsid.checks import bad_input, require
from jaxsid.mechanics.lumped import LumpedModel, free_bodies, loose_bodies
from jaxsid.physical.cbsi import visible_states
from jaxsid.records import Record


class Setting(eqx.Module):
    """The system as it was measured.

    Attributes:
        outputs: names of the measured sensors, in the model's order.
        kinds: their kinds.
        places: index of the body of each.
        one_a_body: index of one output for each body; None where a body has no sensor.
        collocated: for each input the index of its body.
        rigid: (N, k) displacement patterns that no spring resists.
        loose: (N, l) velocity patterns that neither spring nor damper resists; all of `rigid` or none.
        visible: number of states that these sensors can see.
    """

    outputs: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    one_a_body: tuple[int, ...] | None = eqx.field(static=True)
    collocated: tuple[int, ...] = eqx.field(static=True)
    rigid: np.ndarray
    loose: np.ndarray
    visible: int = eqx.field(static=True)


def setting(model: LumpedModel, records: Sequence[Record]) -> Setting:
    """Match the records with the model.

    Args:
        model: its topology and sensors count here, not its numbers.
        records: of this system.

    Raises:
        InputError: no records, or channels that the model does not know.
    """
    require(len(records) > 0, "no record was given: there is nothing to identify from.")
    known = {s.name: s for s in model.sensors}
    for r in records:
        for name in r.outputs:
            if name not in known:
                bad_input(f"{r.name}: output '{name}' is no sensor of the model ({', '.join(known)}).")
        if set(r.inputs) != {i.name for i in model.inputs}:
            bad_input(
                f"{r.name}: inputs {r.inputs} are not those of the model: {[i.name for i in model.inputs]}."
            )
    measured = {name for r in records for name in r.outputs}
    sensors = [s for s in model.sensors if s.name in measured]
    bodies = list(model.bodies)
    places = tuple(bodies.index(s.body) for s in sensors)
    rigid, loose = free_bodies(model), loose_bodies(model)
    if rigid.shape[1] == 0 or np.linalg.matrix_rank(np.hstack([rigid, loose])) != loose.shape[1]:
        loose = np.zeros((len(bodies), 0))
    kinds = tuple(s.kind for s in sensors)
    return Setting(
        outputs=tuple(s.name for s in sensors),
        kinds=kinds,
        places=places,
        one_a_body=tuple(places.index(b) for b in range(len(bodies)))
        if set(places) >= set(range(len(bodies)))
        else None,
        collocated=tuple(bodies.index(i.body) for i in model.inputs),
        rigid=rigid,
        loose=loose,
        visible=visible_states(len(bodies), kinds, rigid.shape[1], loose.shape[1]),
    )
