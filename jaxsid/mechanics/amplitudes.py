"""How every place of an effect moves in a record, which says how large the effect's parameters may be."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsid.compilation import compiled
from jaxsid.mechanics.effects.prior import Amplitudes
from jaxsid.mechanics.slots import Slots, nominal_at
from jaxsid.records import SecondOrderModel


@compiled
def amplitudes(
    linear: SecondOrderModel,
    slots: Slots,
    displacements: Float[Array, "samples N"],
    velocities: Float[Array, "samples N"],
    u: Float[Array, "samples inputs"],
    y: Float[Array, "samples outputs"],
    dt: Array | float,
) -> Amplitudes:
    """Rms values at the place of every slot, each (slots,).

    What a place carries is the larger of the sum of all that acts on its ends, B u - K x - D x', shared between them,
    and of k d + c v where the model has a connection there: a light bearing carries little, and may rub far more.

    Args:
        linear: M, D, K and inputs, without effects.
        slots: the places; their kinds and parameters do not count.
        displacements: of the bodies, m or rad.
        velocities: of the bodies.
        u: inputs.
        y: readings, NaN where there are none.
        dt: sampling interval, s.
    """
    nominal = nominal_at(slots, linear)
    ends = jnp.abs(slots.joints).sum(axis=1)
    d, v = (x @ slots.joints.T for x in (displacements, velocities))
    net = u @ linear.input_matrix.T - displacements @ linear.stiffness.T - velocities @ linear.damping.T
    between = ((slots.joints * slots.pushes).sum(axis=1) < 0) & (
        (nominal.stiffness != 0) | (nominal.damping != 0)
    )
    whole = net @ slots.joints.T / jnp.maximum(ends, 1.0)
    joined = jnp.where(between, nominal.stiffness * d + nominal.damping * v, 0.0)
    force = jnp.maximum(_rms(joined), _rms(whole))
    read = jnp.sqrt(jnp.nanmean(y**2, axis=0))
    slowest = _slowest(linear)
    # a free axis has no mode: half a period in the record
    rate = jnp.where(jnp.isfinite(slowest), jnp.sqrt(slowest), jnp.pi / (len(u) * dt))
    signal = slots.sensors @ jnp.where(jnp.isfinite(read), read, 0.0) + slots.inputs @ _rms(u)
    same = jnp.ones_like(ends)
    return Amplitudes(force, _rms(d), _rms(v), signal, rate * same, len(u) * dt * same)


def _rms(x: Array) -> Array:
    return jnp.sqrt((x**2).mean(axis=0))


def _slowest(linear: SecondOrderModel) -> Array:
    """Square of the slowest natural frequency that is not a free motion's."""
    root = jnp.linalg.cholesky(linear.mass)
    half = jnp.linalg.solve(root, linear.stiffness)
    squares = jnp.linalg.eigvalsh(jnp.linalg.solve(root, half.T))
    moving = squares > 1e-9 * squares[-1]
    return jnp.where(moving, squares, jnp.inf).min()
