"""Values of elements as unknowns: they make the matrices of the model, and come back from them."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsid.mechanics.lumped import Connection, Input, Matrices, Sensor, lumped_model, second_order
from jaxsid.physical.elements import element_matrices, with_values

BODIES = ["a", "b", "c"]
PLACES = {"inputs": [Input("f", "a")], "sensors": [Sensor("s", "b", "velocity")]}
JOINTS = [
    Connection("wall", ("ground", "a")),
    Connection("near", ("a", "b")),
    Connection("far", ("c", "a")),
    Connection("again", ("b", "a")),
]
STIFFNESS, DAMPING = [5.0, 2.0, 3.0, 0.0], [0.1, 0.0, 0.3, 0.4]
MODEL = lumped_model(BODIES, [1.0, 2.0, 3.0], STIFFNESS, DAMPING, connections=JOINTS, **PLACES)


def in_matrices(mass, damping, stiffness):
    return lumped_model(
        BODIES, matrices=Matrices(*(jnp.asarray(x, float) for x in (mass, damping, stiffness))), **PLACES
    )


def triple(model):
    whole = second_order(model)
    return whole.mass, whole.damping, whole.stiffness


WHOLE = in_matrices(*triple(MODEL))
FREE = in_matrices(
    [[2.0, 0.1, 0], [0.1, 1, 0], [0, 0, 1]],
    np.zeros((3, 3)),
    [[2.0, -2, 0], [-2, 3 + 1e-13, -1], [0, -1, 1]],
)


@pytest.mark.parametrize("model", [MODEL, WHOLE, FREE], ids=["elements", "matrices", "free matrices"])
def test_nominal_values_make_the_matrices_of_the_model(model):
    unknowns = element_matrices(model)
    theta = unknowns.of_values(jnp.asarray(unknowns.nominal))
    for made, given in zip(unknowns.matrices(theta), triple(model), strict=True):
        np.testing.assert_allclose(made, given, atol=1e-12)
    for made, given in zip(
        triple(with_values(model, jnp.asarray(unknowns.nominal))), triple(model), strict=True
    ):
        np.testing.assert_allclose(made, given, atol=1e-12)


@pytest.mark.parametrize("model", [WHOLE, FREE], ids=["matrices", "free matrices"])
def test_unknowns_come_back_from_matrices(model):
    unknowns = element_matrices(model)
    theta = jnp.asarray(np.random.default_rng(0).uniform(0.5, 2.0, len(unknowns.listed)))
    np.testing.assert_allclose(unknowns.unknowns(unknowns.matrices(theta)), theta, rtol=1e-10)


def test_names_say_which_number_of_which_element():
    names = [x.name for x in element_matrices(MODEL).listed]
    assert names[:4] == ["a.mass", "b.mass", "c.mass", "wall.damping"]
    assert names[-1] == "again.stiffness"
    assert [x.name for x in element_matrices(FREE).listed] == [
        *("a.mass", "a, b.mass", "b.mass", "c.mass", "a, b.damping", "b, c.damping"),
        *("a, b.stiffness", "b, c.stiffness"),
    ]


def test_a_connection_without_stiffness_stays_so_but_springs_may_damp():
    unknowns = element_matrices(MODEL)
    held = {x.name for x, row in zip(unknowns.listed, unknowns.mix, strict=True) if not row.any()}
    assert held == {"again.stiffness"}
    moved = unknowns.matrices(jnp.full(len(unknowns.listed), 2.0))[2]
    np.testing.assert_allclose(moved[0, 1], -2 * STIFFNESS[1])


def test_free_matrices_keep_the_motion_that_no_spring_resists():
    unknowns = element_matrices(FREE)
    theta = jnp.asarray(np.random.default_rng(1).standard_normal(len(unknowns.listed)))
    _, damping, stiffness = unknowns.matrices(theta)
    np.testing.assert_allclose(damping @ jnp.ones(3), 0.0, atol=1e-12)
    np.testing.assert_allclose(stiffness @ jnp.ones(3), 0.0, atol=1e-12)
