"""Assembly of lumped models, their rigid-body motions, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsid.checks import InputError
from jaxsid.mechanics.lumped import (
    Connection,
    Effect,
    Input,
    Matrices,
    Sensor,
    free_bodies,
    loose_bodies,
    lumped_model,
    second_order,
)

GEARBOX = Connection("gearbox", ("motor", "load"))


def drive(**changes):
    given = {
        "bodies": ("motor", "load"),
        "mass": [0.0053, 0.18],
        "stiffness": [9365.0],
        "damping": [0.8268],
        "connections": [GEARBOX],
        "inputs": [Input("torque", "motor")],
        "sensors": [Sensor("gyro", "load", "velocity"), Sensor("acc", "motor", "acceleration")],
    }
    return lumped_model(**{**given, **changes})


def matrices(
    mass=((1.0, 0.0), (0.0, 2.0)), damping=((1.0, -1.0), (-1.0, 1.0)), stiffness=((3.0, 0.0), (0.0, 0.0))
):
    return Matrices(*(jnp.asarray(x) for x in (mass, damping, stiffness)))


def of_matrices(**changes):
    return drive(mass=(), stiffness=(), damping=(), connections=(), matrices=matrices(**changes))


def test_assembles_the_reference_chain():
    ends = ("ground", "a", "b", "c", "ground")
    model = lumped_model(
        "abc",
        [1.0, 1.0, 1.0],
        [2.0, 2.0, 2.0, 20.0],
        [0.1, 0.1, 0.1, 1.0],
        connections=[Connection(f"k{i}", ends[i : i + 2]) for i in range(4)],
    )
    so = second_order(model)
    np.testing.assert_allclose(so.stiffness, [[4, -2, 0], [-2, 4, -2], [0, -2, 22]], atol=1e-14)
    np.testing.assert_allclose(so.damping, [[0.2, -0.1, 0], [-0.1, 0.2, -0.1], [0, -0.1, 1.1]], atol=1e-15)
    np.testing.assert_array_equal(so.mass, np.eye(3))
    assert so.input_matrix.shape == (3, 0)


def test_inputs_and_sensors_go_to_their_bodies():
    so = second_order(drive())
    np.testing.assert_array_equal(so.input_matrix, [[1], [0]])
    np.testing.assert_array_equal(so.displacement_sensors, np.zeros((2, 2)))
    np.testing.assert_array_equal(so.velocity_sensors, [[0, 1], [0, 0]])
    np.testing.assert_array_equal(so.acceleration_sensors, [[0, 0], [1, 0]])


def test_matrices_pass_unchanged_and_sensors_apply():
    so = second_order(of_matrices())
    np.testing.assert_array_equal(so.mass, [[1, 0], [0, 2]])
    np.testing.assert_array_equal(so.velocity_sensors, [[0, 1], [0, 0]])


def test_energy_is_that_of_the_elements():
    """x' K x = sum of k d^2 for any displacement, parallel and grounded springs included."""
    ends = [("motor", "load"), ("load", "motor"), ("ground", "load")]
    k = np.array([3.0, 5.0, 7.0])
    model = drive(stiffness=k, damping=k, connections=[Connection(str(i), e) for i, e in enumerate(ends)])
    x = np.array([0.3, -1.1])
    d = np.array([x[1] - x[0], x[0] - x[1], x[1]])
    np.testing.assert_allclose(x @ np.asarray(second_order(model).stiffness) @ x, k @ d**2, rtol=1e-14)


def test_differentiable_and_traceable():
    def entry(k):
        return second_order(drive(stiffness=k)).stiffness[0, 1]

    np.testing.assert_allclose(jax.grad(entry)(jnp.array([2.0])), [-1.0])
    np.testing.assert_allclose(jax.jit(entry)(jnp.array([2.0])), -2.0)
    np.testing.assert_allclose(jax.vmap(entry)(jnp.array([[2.0], [3.0]])), [-2.0, -3.0])


def test_single_precision_stays():
    so = second_order(
        drive(**{x: jnp.ones(n, jnp.float32) for x, n in (("mass", 2), ("stiffness", 1), ("damping", 1))})
    )
    assert {x.dtype for x in jax.tree.leaves(so)} == {jnp.dtype("float32")}


def test_free_and_loose_bodies_by_topology():
    connections = [GEARBOX, Connection("bearing", ("ground", "load"))]
    held = drive(stiffness=[1.0, 2.0], damping=[0.0, 1.0], connections=connections)
    assert free_bodies(held).shape == (2, 0)
    np.testing.assert_array_equal(loose_bodies(held), [[1], [0]])
    np.testing.assert_array_equal(free_bodies(drive()), [[1], [1]])
    apart = drive(stiffness=[0.0, 0.0], damping=[0.0, 0.0], connections=connections)
    np.testing.assert_array_equal(free_bodies(apart), np.eye(2))


def test_free_and_loose_bodies_of_matrices():
    model = of_matrices()
    np.testing.assert_allclose(free_bodies(model), [[0], [1]], atol=1e-12)
    np.testing.assert_allclose(loose_bodies(model), [[1], [1]], atol=1e-12)
    assert free_bodies(of_matrices(stiffness=np.eye(2))).shape == (2, 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bodies": ("ground", "load")}, "reserved"),
        ({"bodies": ("load", "load")}, "'load' is used twice"),
        ({"bodies": (), "mass": ()}, "at least one body"),
        ({"mass": [0.0, 1.0]}, "mass of 'motor' must be positive"),
        ({"mass": [1.0]}, "2 bodies need as many masses"),
        ({"mass": [np.nan, 1.0]}, "NaN or infinite"),
        ({"stiffness": [-1.0]}, "stiffness of 'gearbox' must be zero or positive"),
        ({"damping": [-1.0]}, "damping of 'gearbox' must be zero or positive"),
        ({"stiffness": [1.0, 2.0]}, "1 connections need as many of stiffness"),
        (
            {"connections": [Connection("c", ("motor", "wheel"))]},
            "body 'wheel' is unknown; choose from motor, load",
        ),
        ({"connections": [Connection("c", ("motor", "motor"))]}, "joins 'motor' to itself"),
        (
            {"connections": [GEARBOX, GEARBOX], "stiffness": [1, 1], "damping": [1, 1]},
            "'gearbox' is used twice",
        ),
        ({"inputs": [Input("t", "wheel")]}, "input 't': body 'wheel' is unknown"),
        ({"inputs": [Input("t", "ground")]}, "body 'ground' is unknown"),
        (
            {"inputs": [Input("t", "load", "second")]},
            "hold 'second' is unknown; choose from zero, first, band",
        ),
        ({"inputs": [Input("gyro", "load")]}, "'gyro' is used twice"),
        ({"inputs": [Input("time", "load")]}, "'time' is the record's"),
        ({"sensors": [Sensor("s", "wheel", "velocity")]}, "sensor 's': body 'wheel' is unknown"),
        ({"sensors": [Sensor("s", "load", "speed")]}, "kind 'speed' is unknown"),
        ({"tolerance": (-0.1, 0.1, 0.1)}, "tolerance 'mass'"),
        ({"matrices": matrices()}, "either matrices or masses"),
        ({"effects": [Effect("f", (("between", ("motor", "wheel")),), {})]}, "body 'wheel' is unknown"),
        ({"effects": [Effect("f", (("sensor", "torque"),), {})]}, "sensor 'torque' is unknown"),
        ({"effects": [Effect("f", (("where", "torque"),), {})]}, "place 'where' is unknown"),
    ],
)
def test_bad_models_are_refused_with_the_reason(changes, message):
    with pytest.raises(InputError, match=message):
        drive(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": np.eye(3)}, "2 bodies need 2 x 2"),
        ({"stiffness": [[1.0, 2.0], [1.0, 1.0]]}, "'stiffness': not symmetric"),
        ({"mass": [[1.0, 2.0], [2.0, 1.0]]}, "not positive definite"),
        ({"damping": [[np.inf, 0.0], [0.0, 1.0]]}, "NaN or infinite"),
    ],
)
def test_bad_matrices_are_refused_with_the_reason(changes, message):
    with pytest.raises(InputError, match=message):
        of_matrices(**changes)
