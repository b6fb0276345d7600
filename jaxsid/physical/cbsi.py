"""Common-basis structured identification (CBSI): mass, damping and stiffness from a realization.

Every sensor sits at one degree of freedom, so the rows of the state that mean displacement, velocity and
acceleration of all bodies follow from C and A:
    displacement Q, velocity V = Q A, acceleration W = V A, with C = Q, V or W row by row.
In these coordinates W = -M^-1 K Q - M^-1 D V and V B = M^-1 B_u. The inverse mass is the symmetric matrix
with M^-1 B_u = V B for all inputs together, for which M^-1 K M^-1 is symmetric too: the same as
sum_i s_i^2 phi_i phi_i' over the eigenvectors of M^-1 K, without having to find these.

A body that no spring holds to ground has no displacement that velocity or acceleration sensors could see,
and without dampers to ground no velocity that accelerometers could see. Differences between bodies remain,
and are all that stiffness and damping act on.

Source: thesis [5.9-5.26]; K. Alvin and K. Park, "Second-order structural identification procedure via
state-space-based system identification", AIAA J. 32 (1994).
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxsid.checks import require
from jaxsid.compilation import compiled
from jaxsid.mechanics.hold import continuous
from jaxsid.physical.symmetric import symmetric_positive
from jaxsid.records import (
    SENSOR_KINDS,
    CbsiDiagnostics,
    ContinuousModel,
    Realization,
    SecondOrderModel,
    as_array,
)

SOLUTIONS = ("inverse", "symmetric")


def cbsi(
    realization: Realization | ContinuousModel,
    *,
    sensors: Sequence[str],
    collocated: Sequence[int],
    solution: str = "inverse",
    rigid: ArrayLike | None = None,
    loose: ArrayLike | None = None,
) -> SecondOrderModel:
    """Mass, damping and stiffness of a system with one sensor at each degree of freedom.

    -[M^-1 K, M^-1 D] = W [Q; V]^-1, M^-1 B_u = V B, with Q, V, W the displacement, velocity and acceleration
    rows of the state.

    Args:
        realization: of order 2 N; without unobservable rigid-body states where `rigid` is given: 2 N - k for
            velocity sensors, 2 N - 2 k for accelerometers without dampers to ground (2 N - k with them).
        sensors: kind of each output, "displacement", "velocity" or "acceleration", in the order of the bodies.
        collocated: for each input the index of the sensor on the body that it acts on.
        solution: "inverse" (the thesis's, exact on exact data; damping may come out asymmetric) or "symmetric"
            (least squares over symmetric M > 0, D >= 0, K >= 0).
        rigid: (N, k) displacement patterns that no spring resists, such as a column of ones; None if every
            body is held.
        loose: (N, l) those among them that no damper resists either.

    Returns:
        SecondOrderModel with `diagnostics`. A mode that no input drives cannot be scaled: its numbers are inf
        or NaN.

    Raises:
        InputError: orders, kinds or places that do not go together.
    """
    model = realization if isinstance(realization, ContinuousModel) else continuous(realization)
    kinds, places = tuple(sensors), tuple(int(i) for i in collocated)
    rigid, loose = _patterns(rigid, len(kinds)), _patterns(loose, len(kinds))
    _check(model, kinds, places, solution, rigid.shape[1], loose.shape[1])
    complement = np.linalg.svd(rigid)[0][:, rigid.shape[1] :]
    free, held = as_array(rigid), as_array(complement)
    return _cbsi(model, kinds, places, solution == "symmetric", free, held, loose.shape[1] > 0)


def visible_states(bodies: int, sensors: Sequence[str], rigid: int, loose: int) -> int:
    """Number of states that sensors of these kinds can see.

    Velocity sensors miss the position of what no spring holds, accelerometers also its velocity where no
    damper resists it.

    Args:
        bodies: number of degrees of freedom.
        sensors: kind of each sensor.
        rigid: number of displacement patterns that no spring resists.
        loose: number of those that no damper resists either.
    """
    if "displacement" in sensors:
        return 2 * bodies
    return 2 * bodies - rigid - (0 if "velocity" in sensors else loose)


def _patterns(patterns: ArrayLike | None, bodies: int) -> np.ndarray:
    return (
        np.zeros((bodies, 0)) if patterns is None else np.asarray(patterns, dtype=float).reshape(bodies, -1)
    )


def _check(
    model: ContinuousModel,
    kinds: tuple[str, ...],
    places: tuple[int, ...],
    solution: str,
    rigid: int,
    loose: int,
) -> None:
    outputs, inputs, order = model.C.shape[0], model.B.shape[1], model.A.shape[0]
    require(solution in SOLUTIONS, f"solution '{solution}' is unknown; choose from {', '.join(SOLUTIONS)}.")
    for kind in kinds:
        require(
            kind in SENSOR_KINDS, f"sensor kind '{kind}' is unknown; choose from {', '.join(SENSOR_KINDS)}."
        )
    require(
        len(kinds) == outputs,
        f"CBSI needs one sensor at each degree of freedom: {outputs} outputs but {len(kinds)} sensor kinds. With "
        "fewer sensors than bodies only poles and the shapes at the sensors can be identified.",
    )
    require(
        len(places) == inputs and all(0 <= i < outputs for i in places),
        f"`collocated` must name, for each of the {inputs} inputs, the sensor (0 to {outputs - 1}) on its body.",
    )
    require(loose in (0, rigid), "`loose` must hold all patterns of `rigid`, or none.")
    require(not rigid or len(set(kinds)) == 1, "with rigid-body motion the sensors must all be of one kind")
    expected = visible_states(outputs, kinds, rigid, loose)
    require(
        order == expected,
        f"{outputs} bodies seen by {', '.join(dict.fromkeys(kinds))} sensors have {expected} visible states, but the "
        f"realization has order {order}: realize it with order={expected}"
        + ("." if rigid else ", or give the rigid-body patterns that no spring resists."),
    )


@compiled
def _cbsi(
    model: ContinuousModel,
    kinds: tuple[str, ...],
    places: tuple[int, ...],
    symmetric: bool,
    rigid: Float[Array, "N k"],
    complement: Float[Array, "N q"],
    loose: bool,
) -> SecondOrderModel:
    bodies = len(kinds)
    spring, damper, displacement, velocity, acceleration = _motion(model, kinds, rigid, complement, loose)
    per_mass = -jnp.linalg.solve(jnp.concatenate([displacement, velocity]).T, acceleration.T).T
    stiffness_per_mass = per_mass[:, : len(displacement)] @ spring.T
    damping_per_mass = per_mass[:, len(displacement) :] @ damper.T
    B_u = jnp.eye(bodies)[:, jnp.array(places)]
    gained = _gained(model, kinds, len(velocity) == bodies)
    inverse_mass = _inverse_mass(stiffness_per_mass, B_u, gained)
    mass = jnp.linalg.inv(inverse_mass)
    matrices = mass, mass @ damping_per_mass, mass @ stiffness_per_mass
    diagnostics = _diagnostics(model, kinds, matrices, inverse_mass, gained)
    if symmetric:
        states = spring @ displacement, damper @ velocity, acceleration
        held = complement if rigid.shape[1] else spring
        matrices = symmetric_positive(matrices, states, model.B, gained, B_u, held, held if loose else damper)
    seen = (jnp.diag(jnp.array([1.0 * (k == kind) for k in kinds])) for kind in SENSOR_KINDS)
    displaced, moved, accelerated = seen
    return SecondOrderModel(*matrices, B_u, displaced, moved, accelerated, diagnostics)


def _motion(
    model: ContinuousModel, kinds: tuple[str, ...], rigid: Array, complement: Array, loose: bool
) -> tuple[Array, ...]:
    """What springs and dampers act on: complements of the free patterns, and the state rows of Q, V, W in them."""
    A, C = model.A, model.C
    identity = jnp.eye(len(kinds))
    if not rigid.shape[1] or kinds[0] == "displacement":
        back = jnp.linalg.solve(A.T, C.T).T if set(kinds) != {"displacement"} else C
        back2 = jnp.linalg.solve(A.T, back.T).T if "acceleration" in kinds else back
        rows = {
            "displacement": (C, C @ A, C @ A @ A),
            "velocity": (back, C, C @ A),
            "acceleration": (back2, back, C),
        }
        Q, V, W = (jnp.stack([rows[kind][d][i] for i, kind in enumerate(kinds)]) for d in range(3))
        return identity, identity, Q, V, W
    if kinds[0] == "velocity":
        relative = complement.T @ C
        if loose:  # a pole at zero: the relative displacement of rigid motion is zero by definition
            observed = jnp.concatenate([C, C @ A])
            still = jnp.linalg.lstsq(observed, jnp.concatenate([rigid, 0 * rigid]))[0]
            held = jnp.concatenate([A, still * jnp.linalg.norm(A)], axis=1)
            target = jnp.concatenate([relative, jnp.zeros((len(relative), rigid.shape[1]))], axis=1)
            displacement = jnp.linalg.lstsq(held.T, target.T)[0].T
        else:
            displacement = jnp.linalg.solve(A.T, relative.T).T
        return complement, identity, displacement, C, C @ A
    damper = complement if loose else identity
    velocity = jnp.linalg.solve(A.T, (damper.T @ C).T).T
    relative = velocity if loose else complement.T @ velocity
    return complement, damper, jnp.linalg.solve(A.T, relative.T).T, velocity, C


def _gained(model: ContinuousModel, kinds: tuple[str, ...], held: bool) -> Array:
    """M^-1 B_u, the velocity gained from a unit impulse: by sensor kind C A B, C B, or C A^-1 B.

    The last is the feedthrough D less the response to a constant force, which is zero for accelerometers; where
    rigid motion makes A^-1 meaningless it is D itself.
    """
    A, B, C = model.A, model.B, model.C
    through = jnp.linalg.solve(A.T, C.T).T @ B if "acceleration" in kinds and held else model.D
    rows = {"displacement": C @ A @ B, "velocity": C @ B, "acceleration": through}
    return jnp.stack([rows[kind][i] for i, kind in enumerate(kinds)])


def _inverse_mass(L: Array, B_u: Array, gained: Array) -> Array:
    """Symmetric S minimizing norm(S B_u - gained) subject to L S = S L', by Lagrange multipliers."""
    n = len(L)
    i, j = np.triu_indices(n)
    basis = np.zeros((len(i), n, n))
    basis[np.arange(len(i)), i, j] = basis[np.arange(len(i)), j, i] = 1.0
    scale = jnp.sqrt(jnp.abs(jnp.diag(L)))
    # unit diagonal of K: masses and stiffnesses of very different sizes weigh alike
    scale = jnp.where(scale > 0, scale, 1.0)
    basis = basis * scale[:, None] * scale
    fitted = ((basis @ B_u) / scale[:, None]).reshape(len(i), -1).T
    skew = L / jnp.linalg.norm(L) @ basis
    a, b = np.triu_indices(n, 1)
    constraint = ((skew - jnp.swapaxes(skew, 1, 2))[:, a, b] / (scale[a] * scale[b])).T
    size = jnp.linalg.norm(fitted)
    rows = len(a)
    system = jnp.block([[fitted.T @ fitted / size**2, constraint.T], [constraint, -1e-15 * jnp.eye(rows)]])
    target = fitted.T @ (gained / scale[:, None]).ravel() / size**2
    coefficients = jnp.linalg.solve(system, jnp.concatenate([target, jnp.zeros(rows)]))[: len(i)]
    return jnp.einsum("p,pij->ij", coefficients, basis)


def _diagnostics(
    model: ContinuousModel,
    kinds: tuple[str, ...],
    matrices: tuple[Array, Array, Array],
    inverse_mass: Array,
    gained: Array,
) -> CbsiDiagnostics:
    """Contradictions in the realization, before any of them is averaged away."""
    # at once, a force moves no displacement and no velocity, and accelerates by M^-1 B_u
    displaced = [
        (model.C @ model.B)[i] * jnp.linalg.norm(model.A) for i, k in enumerate(kinds) if k == "displacement"
    ]
    at_once = [model.D[i] - (gained[i] if k == "acceleration" else 0.0) for i, k in enumerate(kinds)]
    size = jnp.linalg.norm(gained)
    return CbsiDiagnostics(
        upper_block_error=jnp.linalg.norm(jnp.stack(displaced or [0 * gained[0]])) / size,
        feedthrough_error=jnp.linalg.norm(jnp.stack(at_once)) / size,
        mass_asymmetry=_asymmetry(matrices[0]),
        damping_asymmetry=_asymmetry(matrices[1]),
        stiffness_asymmetry=_asymmetry(matrices[2]),
        negative_scales=(jnp.linalg.eigvalsh(inverse_mass) < 0).sum().astype(gained.dtype),
    )


def _asymmetry(x: Float[Array, "N N"]) -> Array:
    return jnp.linalg.norm(x - x.T) / jnp.maximum(jnp.linalg.norm(x + x.T), jnp.finfo(x.dtype).tiny)
