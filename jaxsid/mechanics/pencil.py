"""Complex modes of M q'' + D q' + K q = 0, normalized by the symmetric pencil."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex

from jaxsid.checks import InsufficientDataError, is_concrete
from jaxsid.compilation import compiled
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.records import SecondOrderModel


class ComplexModes(eqx.Module):
    """Poles and displacement shapes, slowest first, conjugate pairs adjacent.

    Attributes:
        poles: (2N,) complex, 1/s.
        shapes: (N, 2N) complex X, scaled so that Z = [X; X L] has Z^T [[D, M], [M, 0]] Z = I.
    """

    poles: Complex[Array, " n"]
    shapes: Complex[Array, "N n"]


def complex_modes(model: SecondOrderModel) -> ComplexModes:
    """Complex modes: Z^T [[D, M], [M, 0]] Z = I, Z^T [[K, 0], [0, -M]] Z = -L, Z = [X; X L] [3.28-3.30].

    The transpose, not the conjugate: the shape of an overdamped mode is real, or imaginary where its sign
    demands it. Damping need not be proportional; poles may be repeated while they have shapes enough.

    Args:
        model: symmetric M, D, K, M positive definite.

    Raises:
        InsufficientDataError: a rigid-body motion that neither spring nor damper holds (a defective double
            pole at zero), or a critically damped mode: there the pencil has fewer shapes than poles and the
            normalization does not exist. Meaningless there for traced values.
    """
    concrete = is_concrete(model.mass, model.damping, model.stiffness)
    if concrete:
        _check_held(model)
    poles, shapes, error = _modes(model)
    if concrete and not float(error) < 1e-3:
        raise InsufficientDataError(
            "two poles coincide and share one shape (a critically damped mode), so that the complex modes "
            "are incomplete. Change a damper slightly, or work with a first-order form."
        )
    return ComplexModes(poles, shapes)


def _check_held(model: SecondOrderModel) -> None:
    """Every motion must meet a spring or a damper; judged per unit of mass, against the stiffest."""
    lower = np.linalg.inv(np.linalg.cholesky(np.asarray(model.mass, float)))
    scaled = [lower @ np.asarray(x, float) @ lower.T for x in (model.stiffness, model.damping)]
    held = np.vstack([x / max(np.abs(x).max(), np.finfo(float).tiny) for x in scaled])
    vectors, smallest = np.linalg.svd(held)[2][-1], np.linalg.svd(held, compute_uv=False)[-1]
    if smallest <= 100 * len(lower) * np.finfo(np.asarray(model.mass).dtype).eps:
        motion = ", ".join(f"{x:.3g}" for x in lower.T @ vectors)
        raise InsufficientDataError(
            f"the rigid-body motion ({motion}) meets neither spring nor damper: its double pole at zero is "
            "defective and has no complex modes. Ground it by a spring or damper, or use a first-order form."
        )


@compiled
def _modes(model: SecondOrderModel) -> tuple[Array, Array, Array]:
    """Sorted poles, normalized shapes, and the largest entry of Z^T [[D, M], [M, 0]] Z - I."""
    A = physical_displacement_velocity(model).A
    poles, vectors = jnp.linalg.eig(A)
    # LAPACK leaves conjugate pairs adjacent and exactly conjugate, and the sort is stable
    order = jnp.argsort(jnp.abs(poles))
    poles, shapes = poles[order], vectors[: len(model.mass), order]

    def pencil(shapes: Array) -> Array:
        mixed = shapes.T @ model.mass @ shapes
        return shapes.T @ model.damping @ shapes + mixed * poles + poles[:, None] * mixed

    close = 1e3 * jnp.finfo(A.dtype).eps * jnp.max(jnp.abs(poles))
    equal = jnp.abs(poles - poles[:, None]) <= close
    shapes = shapes @ _inverse_root(jnp.where(equal, pencil(shapes), 0.0), equal)
    # rounding must not make a pair lose its symmetry
    second = (poles.imag < 0) & (poles == jnp.roll(poles, 1).conj())
    shapes = jnp.where(second, jnp.roll(shapes, 1, axis=1).conj(), shapes)
    error = jnp.max(jnp.abs(pencil(shapes) - jnp.eye(len(poles))))
    return poles, shapes, error


def _inverse_root(gram: Array, equal: Array) -> Array:
    """T with T^T gram T = I for a complex symmetric, block-diagonal Gram matrix, one block a distinct pole.

    A lone pole needs a square root only. For a repeated one the Denman-Beavers iteration gives gram^-1/2,
    which is symmetric; a phase keeps its eigenvalues off the negative real axis.
    """
    size = len(gram)
    eye = jnp.eye(size, dtype=gram.dtype)
    alone = equal.sum(1) == 1
    own = jnp.sqrt(jnp.diagonal(gram))
    phase = jnp.exp(jnp.asarray(0.7j, gram.dtype))
    block = jnp.where(alone[:, None] | alone, eye, gram * phase)
    scale = jnp.sqrt(jnp.abs(jnp.trace(block @ block.conj().T)) / size)
    block = jnp.where(alone[:, None] | alone, eye, block / scale)

    def newton(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        root, rest = carry
        inverse = jnp.linalg.inv(rest)
        return (root @ (eye + inverse) / 2, (eye + (rest + inverse) / 2) / 2), None

    (root, _), _ = lax.scan(newton, (block, block), length=25)
    several = jnp.linalg.inv(root) * jnp.sqrt(phase / scale)
    return jnp.where(alone[:, None] & alone, jnp.diag(1 / jnp.where(alone, own, 1.0)), several)


def is_proportional(model: SecondOrderModel, *, tolerance: float = 1e-9) -> Bool[Array, ""]:
    """Whether the damping leaves the modes real: K M^-1 D symmetric (Caughey, J. Appl. Mech. 32, 1965).

    Args:
        model: symmetric M, D, K, M positive definite.
        tolerance: on the norm of the asymmetry, relative to the product of the norms, per unit of mass.
    """
    return _asymmetry(model) <= tolerance


@compiled
def _asymmetry(model: SecondOrderModel) -> Array:
    inverse = jnp.linalg.inv(jnp.linalg.cholesky(model.mass))
    stiffness, damping = (inverse @ x @ inverse.T for x in (model.stiffness, model.damping))
    product = stiffness @ damping
    size = jnp.linalg.norm(stiffness) * jnp.linalg.norm(damping)
    return jnp.linalg.norm(product - product.T) / jnp.where(size > 0, size, 1.0)
