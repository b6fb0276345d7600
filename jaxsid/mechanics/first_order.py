"""The four first-order forms of M q'' + D q' + K q = B u: physical or modal, with velocity or momentum.

All have the same transfer function. With x the state, q = [I 0] x (times Phi in the modal forms); since
[I 0] B = 0 in every form, q' = [I 0] A x and q'' = [I 0] A^2 x + M^-1 B u, which gives the sensors' rows
C = [H_d 0] + [H_v 0] A + [H_a 0] A^2 and the feedthrough H_a M^-1 B.
"""

import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.records import ContinuousModel, SecondOrderModel


def _observed(
    model: SecondOrderModel, A: Array, forces: Array, shapes: Array, acceleration: Array
) -> ContinuousModel:
    """Add input and sensor rows to A; `forces` enter the lower half, q = shapes @ upper half of x."""
    position = jnp.hstack([shapes, jnp.zeros_like(shapes)])
    velocity = position @ A
    C = (
        model.displacement_sensors @ position
        + model.velocity_sensors @ velocity
        + model.acceleration_sensors @ (velocity @ A)
    )
    B = jnp.vstack([jnp.zeros_like(forces), forces])
    return ContinuousModel(A, B, C, model.acceleration_sensors @ acceleration)


def _per_mass(model: SecondOrderModel, x: Array) -> Array:
    return cho_solve((jnp.linalg.cholesky(model.mass), True), x)


@compiled
def physical_displacement_velocity(model: SecondOrderModel) -> ContinuousModel:
    """Form I, x = [q; q']: A = [[0, I], [-M^-1 K, -M^-1 D]], B = [0; M^-1 B] [thesis 3.19].

    Args:
        model: M, D, K and where it is driven and sensed; M positive definite, else NaN.
    """
    eye = jnp.eye(len(model.mass), dtype=model.mass.dtype)
    A = jnp.block([[0 * eye, eye], [-_per_mass(model, model.stiffness), -_per_mass(model, model.damping)]])
    acceleration = _per_mass(model, model.input_matrix)
    return _observed(model, A, acceleration, eye, acceleration)


@compiled
def physical_displacement_momentum(model: SecondOrderModel) -> ContinuousModel:
    """Form II, x = [q; M q' + D q]: A = [[-M^-1 D, M^-1], [-K, 0]], B = [0; B] [thesis 3.21].

    Args:
        model: M, D, K and where it is driven and sensed; M positive definite, else NaN.
    """
    eye = jnp.eye(len(model.mass), dtype=model.mass.dtype)
    A = jnp.block([[-_per_mass(model, model.damping), _per_mass(model, eye)], [-model.stiffness, 0 * eye]])
    return _observed(model, A, model.input_matrix, eye, _per_mass(model, model.input_matrix))


@compiled
def normal_modes(model: SecondOrderModel) -> tuple[Float[Array, " N"], Float[Array, "N N"]]:
    """Undamped modes: frequencies squared W^2, slowest first, and Phi, Phi' M Phi = I, Phi' K Phi = W^2.

    Squared frequencies within rounding of zero are zero: rigid-body modes. Repeated frequencies have no
    differentiable shapes.

    Args:
        model: symmetric M and K, M positive definite.
    """
    lower = jnp.linalg.cholesky(model.mass)
    half = solve_triangular(lower, model.stiffness, lower=True)
    scaled = solve_triangular(lower, half.T, lower=True)
    squares, vectors = jnp.linalg.eigh((scaled + scaled.T) / 2)
    rounding = len(squares) * jnp.finfo(squares.dtype).eps * jnp.max(jnp.abs(squares))
    shapes = solve_triangular(lower, vectors, lower=True, trans=1)
    return jnp.where(jnp.abs(squares) <= rounding, 0.0, squares), shapes


def _modal_blocks(model: SecondOrderModel) -> tuple[Array, Array, Array, Array, Array]:
    squares, shapes = normal_modes(model)
    eye = jnp.eye(len(squares), dtype=squares.dtype)
    return eye, jnp.diag(squares), shapes.T @ model.damping @ shapes, shapes.T @ model.input_matrix, shapes


@compiled
def modal_displacement_velocity(model: SecondOrderModel) -> ContinuousModel:
    """Form III, x = [p; p'], q = Phi p: A = [[0, I], [-W^2, -Xi]], B = [0; Phi' B] [thesis 3.25].

    Args:
        model: symmetric M, D, K and where it is driven and sensed; M positive definite, else NaN.
    """
    eye, squares, damping, forces, shapes = _modal_blocks(model)
    A = jnp.block([[0 * eye, eye], [-squares, -damping]])
    return _observed(model, A, forces, shapes, shapes @ forces)


@compiled
def modal_displacement_momentum(model: SecondOrderModel) -> ContinuousModel:
    """Form IV, x = [p; p' + Xi p], q = Phi p: A = [[-Xi, I], [-W^2, 0]], B = [0; Phi' B] [thesis 3.27].

    Args:
        model: symmetric M, D, K and where it is driven and sensed; M positive definite, else NaN.
    """
    eye, squares, damping, forces, shapes = _modal_blocks(model)
    A = jnp.block([[-damping, eye], [-squares, 0 * eye]])
    return _observed(model, A, forces, shapes, shapes @ forces)
