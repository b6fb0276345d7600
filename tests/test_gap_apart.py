"""Sets of places that cannot be told apart: how they are gathered, and what a free axis with friction gives."""

from pathlib import Path

import numpy as np
import pytest
from gap_helpers import chain

import jaxsid
from jaxsid.gap.apart import same_force, sets_of
from jaxsid.gap.examine import examine
from jaxsid.gap.locate import locate
from jaxsid.gap.places import Place, places_of
from jaxsid.mechanics.lumped import Connection, Input, Sensor, Tolerance, lumped_model
from jaxsid.records import Record

DT, MASS, VISCOUS, FRICTION, OFFSET = 0.002, 95.0, 200.0, 20.0, -3.0
GUIDE, FORCE = Place("between", ("ground", "carriage")), Place("input", ("force",))


def test_the_most_probable_gathers_first():
    alike = np.eye(4, dtype=bool)
    alike[2, 0] = alike[0, 3] = alike[1, 3] = True
    found = sets_of([2, 1, 0, 3], alike)
    assert found == [(2, 0), (1, 3), (2, 0), (1, 3)]


def test_the_drive_and_the_ground_bear_the_same_force():
    places = places_of(chain())
    same = same_force(chain(), places)
    assert (same == same.T).all()
    assert same.diagonal().all()
    pairs = {frozenset((places[i], places[j])) for i, j in np.argwhere(same) if i != j}
    assert pairs == {frozenset((Place("between", ("ground", "b1")), Place("input", ("drive",))))}


def axis():
    return lumped_model(
        ["carriage"],
        [MASS],
        [0.0],
        [VISCOUS],
        connections=[Connection("guide", ("ground", "carriage"))],
        inputs=[Input("force", "carriage")],
        sensors=[Sensor("position", "carriage", "displacement")],
        tolerance=Tolerance(),
    )


def rubbed(samples=2000, substeps=20):
    """A free carriage in closed loop along a path of changing speed; friction implicit in its impulse."""
    h, x, v, u, y = DT / substeps, 0.0, 0.0, [], []
    t = np.arange(samples) * DT
    path = 0.05 * np.sin(2 * np.pi * 0.7 * t) + 0.03 * np.sin(2 * np.pi * 1.9 * t)
    for goal in path:
        push = 2e5 * (goal - x) - 4e3 * v
        u.append(push)
        y.append(x)
        for _ in range(substeps):
            free = v + h * (push - VISCOUS * v - OFFSET) / MASS
            v = free - np.clip(free, -h * FRICTION / MASS, h * FRICTION / MASS)
            x += h * v
    noise = 1e-6 * np.random.default_rng(0).standard_normal(samples)
    return Record(
        np.array(u)[:, None], (np.array(y) + noise)[:, None], DT, inputs=("force",), outputs=("position",)
    )


def friction_and_offset(found):
    """Of the force map: half the difference, and less the mean, of the forces while moving one way and the other."""
    fast = np.quantile(np.abs(found.velocity), 0.5)
    there, back = (found.force[s * found.velocity > fast].mean() for s in (1, -1))
    return (back - there) / 2, -(there + back) / 2


@pytest.mark.slow
def test_friction_of_a_free_axis_is_at_its_guide():
    found = locate(axis(), rubbed())
    assert found.ranked[0].place == GUIDE
    assert set(found.likely) <= {GUIDE, FORCE}
    friction, offset = friction_and_offset(found.maps[0])
    assert friction == pytest.approx(FRICTION, rel=0.1)
    assert offset == pytest.approx(OFFSET, abs=1.0)


@pytest.mark.slow
def test_measured_axis(data: Path):
    """Published: Coulomb friction 20.4 N and offset -3.2 N, both at the guide."""
    model = jaxsid.read_model(data / "emps" / "model.toml")
    found = examine(model, jaxsid.read_records(data / "emps" / "records.toml", model))
    assert found.finding == "structure"
    assert found.locations is not None
    assert found.locations.ranked[0].place == GUIDE
    assert set(found.locations.likely) <= {GUIDE, FORCE}
    friction, offset = friction_and_offset(found.locations.maps[0])
    assert friction == pytest.approx(20.4, rel=0.1)
    assert offset == pytest.approx(-3.2, abs=1.5)
