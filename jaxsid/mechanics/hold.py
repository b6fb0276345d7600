"""Exact passage between continuous and sampled models for zero-order, first-order and band-limited inputs.

With L = A dt and phi_1(L) = (e^L - I) / L, phi_2(L) = (e^L - I - L) / L^2, over one interval
x_(k+1) = e^L x_k + dt phi_1 B u_k + dt phi_2 B (u_(k+1) - u_k), the last term for a first-order hold only.
No inverse of A is needed, so rigid-body poles are as good as any.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxsid.checks import InsufficientDataError, is_concrete, require
from jaxsid.compilation import compiled
from jaxsid.mechanics.functions_of_matrices import logarithm, phi_functions
from jaxsid.records import HOLDS, ContinuousModel, Realization, holds

Ramps = Bool[Array, " inputs"] | np.ndarray  # which inputs are held to first order


def check_holds(hold: str | Sequence[str], inputs: int) -> tuple[str, ...]:
    """One hold for each input, or InputError.

    Args:
        hold: "zero", "first" or "band", for all inputs or for each.
        inputs: how many there are.
    """
    each = holds(hold, inputs)
    require(len(each) == inputs, f"{inputs} inputs need as many holds, not {len(each)}.")
    for h in each:
        require(h in HOLDS, f"hold '{h}' is unknown; choose from {', '.join(HOLDS)}.")
    require(
        "band" not in each or set(each) == {"band"},
        "hold 'band' cannot be mixed with 'zero' or 'first': a band-limited model is mapped as a whole. "
        "Simulate those inputs apart and add the outputs.",
    )
    return each


def discretise(model: ContinuousModel, dt: ArrayLike, *, hold: str | Sequence[str] = "zero") -> Realization:
    """The sampled model, exact for the hold: A = e^(A dt), B = dt phi_1 B (zero) or dt phi_1^2 B (first).

    With "first" the state is x_k - dt phi_2 B u_k and D grows by dt C phi_2 B: no future input is needed.
    With "band" it is the bilinear map z = (1 + s dt/2) / (1 - s dt/2): the frequency response at w moves to
    2/dt atan(w dt/2), and its samples are not those of the response; `continuous` undoes it.

    Args:
        model: continuous-time model.
        dt: sampling interval, s.
        hold: "zero", "first" or "band", for all inputs or for each; "band" stands alone.

    Raises:
        InputError: unknown or mixed holds, a sampling interval that is not positive.
    """
    each = check_holds(hold, model.B.shape[1])
    dt = jnp.asarray(dt, model.A.dtype)
    if is_concrete(dt):
        require(float(dt) > 0, f"the sampling interval must be positive, not {float(dt):g} s.")
    matrices = _bilinear(model, dt) if "band" in each else _sample(model, dt, _ramps(each))
    return Realization(*matrices, dt, hold=each)


def _ramps(each: tuple[str, ...]) -> np.ndarray:
    return np.array([h == "first" for h in each])


@compiled
def _sample(model: ContinuousModel, dt: Array, ramps: Ramps) -> tuple[Array, Array, Array, Array]:
    L = model.A * dt
    one, two = phi_functions(L)
    A = jnp.eye(len(L), dtype=L.dtype) + L @ one
    step = dt * one @ model.B
    B = jnp.where(ramps, one @ step, step)
    return A, B, model.C, model.D + jnp.where(ramps, dt * model.C @ two @ model.B, 0.0)


@compiled
def _bilinear(model: ContinuousModel, dt: Array) -> tuple[Array, Array, Array, Array]:
    eye = jnp.eye(len(model.A), dtype=model.A.dtype)
    resolvent = jnp.linalg.inv(eye - model.A * dt / 2)
    B = dt * resolvent @ model.B
    return eye + dt * resolvent @ model.A, B, model.C @ resolvent, model.D + model.C @ B / 2


def continuous(realization: Realization) -> ContinuousModel:
    """The continuous-time model whose samples these are: undoes `discretise`, in real arithmetic.

    A = log(A) / dt, B = phi_1^-1 B / dt (zero) or phi_1^-2 B / dt (first), D less dt C phi_2 B (first); the
    inverse bilinear map for "band". Poles at z = 1 may be repeated and defective (rigid bodies). The relative
    error of a pole s is about eps / abs(s dt) times its condition; abs(z) < 1e-8 is too fast to be recovered.
    Poles within 0.05 rad of the negative real axis lose digits where much faster ones stand beside them.

    Args:
        realization: sampled model with its interval and holds.

    Raises:
        InsufficientDataError: a pole z at zero or on the negative real axis, at or beyond the Nyquist
            frequency (at z = -1, for "band"). NaN where that happens to traced values.
    """
    each = check_holds(realization.hold, realization.B.shape[1])
    if is_concrete(realization.A):
        _check_poles(np.asarray(realization.A), "band" in each)
    plain = (realization.A, realization.B, realization.C, realization.D, realization.dt)
    return _inverse_bilinear(*plain) if "band" in each else _reconstruct(*plain, _ramps(each))


def _check_poles(A: np.ndarray, band: bool) -> None:
    z = np.linalg.eigvals(A)
    rounding = 100 * np.finfo(A.dtype).eps
    bad = np.abs(z + 1) <= rounding if band else (z.real <= 0) & (np.abs(z.imag) <= rounding * np.abs(z))
    if bad.any():
        raise InsufficientDataError(
            f"the sampled model has a pole z = {z[bad][0].real:.6g}, at or beyond the Nyquist frequency: no "
            "real continuous-time model has these samples. Often the order is too high for the data and the "
            "pole fits noise: lower the order, or sample faster."
        )


@compiled
def _reconstruct(A: Array, B: Array, C: Array, D: Array, dt: Array, ramps: Ramps) -> ContinuousModel:
    L, found = logarithm(A)
    one, two = phi_functions(jnp.where(found, L, 0.0))
    step = jnp.linalg.solve(one, B) / dt
    B = jnp.where(ramps, jnp.linalg.solve(one, step), step)
    D = D - jnp.where(ramps, dt * C @ two @ B, 0.0)
    return ContinuousModel(*(jnp.where(found, x, jnp.nan) for x in (L / dt, B, C, D)))


@compiled
def _inverse_bilinear(A: Array, B: Array, C: Array, D: Array, dt: Array) -> ContinuousModel:
    eye = jnp.eye(len(A), dtype=A.dtype)
    twice = 2 * jnp.linalg.inv(eye + A)
    C = C @ twice
    return ContinuousModel(twice @ (A - eye) / dt, twice @ B / dt, C, D - C @ B / 2)


def laguerre_to_shift(
    A: Float[Array, "n n"],
    B: Float[Array, "n inputs"],
    C: Float[Array, "outputs n"],
    D: Float[Array, "outputs inputs"],
    pole: ArrayLike,
) -> tuple[
    Float[Array, "n n"], Float[Array, "n inputs"], Float[Array, "outputs n"], Float[Array, "outputs inputs"]
]:
    """A, B, C, D in the ordinary shift z from those in the Laguerre shift w = (z - a) / (1 - a z).

    With E = I + a A and q = sqrt(1 - a^2): E^-1 (A + a I), q E^-1 B, q C E^-1, D - a C E^-1 B.

    Args:
        A: in w.
        B: in w.
        C: in w.
        D: in w, the value at w = infinity.
        pole: a, real, inside the unit circle.

    Raises:
        InputError: a not inside the unit circle.
    """
    a = jnp.asarray(pole, A.dtype)
    if is_concrete(a):
        require(abs(float(a)) < 1, f"a Laguerre pole must lie inside the unit circle, not at {float(a):g}.")
    return _moebius(A, B, C, D, a)


def shift_to_laguerre(
    A: Float[Array, "n n"],
    B: Float[Array, "n inputs"],
    C: Float[Array, "outputs n"],
    D: Float[Array, "outputs inputs"],
    pole: ArrayLike,
) -> tuple[
    Float[Array, "n n"], Float[Array, "n inputs"], Float[Array, "outputs n"], Float[Array, "outputs inputs"]
]:
    """A, B, C, D in the Laguerre shift w = (z - a) / (1 - a z) from those in z; undoes `laguerre_to_shift`.

    Args:
        A: in z.
        B: in z.
        C: in z.
        D: in z.
        pole: a, real, inside the unit circle.

    Raises:
        InputError: a not inside the unit circle.
    """
    return laguerre_to_shift(A, B, C, D, -jnp.asarray(pole, A.dtype))


@compiled
def _moebius(A: Array, B: Array, C: Array, D: Array, a: Array) -> tuple[Array, Array, Array, Array]:
    eye = jnp.eye(len(A), dtype=A.dtype)
    inverse = jnp.linalg.inv(eye + a * A)
    scale = jnp.sqrt(1 - a**2)
    return inverse @ (A + a * eye), scale * inverse @ B, scale * C @ inverse, D - a * C @ inverse @ B
