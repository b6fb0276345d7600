"""What a study judges: frequencies, damping ratios, real poles, and where they are defined mass, damping, stiffness."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsid.physical.cbsi import cbsi
from jaxsid.realization.lapack import one_at_a_time
from jaxsid.records import Realization
from jaxsid.study.system import Mechanics, System

MATRICES = ("mass", "damping", "stiffness")
_eigenvalues = one_at_a_time(jnp.linalg.eigvals)


class Structure(eqx.Module):
    """What CBSI has to know, all static.

    Attributes:
        rows: an output for each body.
        kinds: of these.
        collocated: body of each input.
        rigid, loose: free patterns, one tuple a pattern.
    """

    rows: tuple[int, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    collocated: tuple[int, ...] = eqx.field(static=True)
    rigid: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    loose: tuple[tuple[float, ...], ...] = eqx.field(static=True)


def structure_of(system: System, order: int) -> Structure | None:
    """How to get M, D and K; None where a body has no sensor, or the order is not that of the bodies.

    With bodies that no spring holds the sensors must be of one kind, too.
    """
    if system.mechanics is None or order != system.order:
        return None
    found = system.mechanics.setting
    if found.one_a_body is None:
        return None
    kinds = tuple(found.kinds[i] for i in found.one_a_body)
    if found.rigid.shape[1] and len(set(kinds)) > 1:
        return None
    rigid, loose = (tuple(tuple(float(v) for v in p) for p in x.T) for x in (found.rigid, found.loose))
    return Structure(found.one_a_body, kinds, found.collocated, rigid, loose)


def names_and_units(system: System, structure: Structure | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names as frequency_1, damping_ratio_1, pole_1 (a real one), mass_1_1, and their units.

    Args:
        system: whose poles are judged; oscillating ones and real ones are counted apart, slowest first.
        structure: None leaves the matrices out.
    """
    swings, still = split(system.poles)
    names = [f"{what}_{i + 1}" for what in ("frequency", "damping_ratio") for i in range(len(swings))]
    names += [f"pole_{i + 1}" for i in range(len(still))]
    units = ["Hz"] * len(swings) + [""] * len(swings) + ["1/s"] * len(still)
    if structure is not None:
        assert system.mechanics is not None
        pairs = list(zip(*np.triu_indices(len(structure.rows)), strict=True))
        names += [f"{what}_{i + 1}_{j + 1}" for what in MATRICES for i, j in pairs]
        units += [unit for unit in system.mechanics.units for _ in pairs]
    return tuple(names), tuple(units)


def split(poles: Complex[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """The oscillating poles and the real ones."""
    swings = np.abs(np.imag(poles)) > 1e-9 * np.abs(poles)
    return poles[swings], np.real(poles[~swings])


def truth_of(system: System, structure: Structure | None) -> Float[np.ndarray, " q"]:
    """The true values, in the order of the names."""
    swings, still = split(system.poles)
    values = [np.abs(swings) / (2 * np.pi), -np.real(swings) / np.abs(swings), still]
    if structure is not None:
        assert isinstance(system.mechanics, Mechanics)
        upper = np.triu_indices(len(structure.rows))
        values += [np.asarray(getattr(system.mechanics.matrices, name))[upper] for name in MATRICES]
    return np.concatenate(values)


def estimates(
    realization: Realization,
    swings: Complex[Array, " k"],
    still: Float[Array, " l"],
    structure: Structure | None,
) -> Float[Array, " q"]:
    """The quantities of a realization; NaN where there are none.

    Each true pole takes the identified one that is nearest in the complex plane of continuous time, whether or not
    another has taken it. The upper triangles of M, D and K are those of the symmetric part.

    Args:
        realization: of any order.
        swings: true oscillating poles, upper half plane, 1/s.
        still: true real poles, 1/s.
        structure: None leaves the matrices out.
    """
    # the eigenvalues of A - I keep the digits that those of A near 1 would lose
    step = _eigenvalues(realization.A - jnp.eye(len(realization.A), dtype=realization.A.dtype))
    found = jnp.log1p(step) / realization.dt
    near, slow = _nearest(found, swings), _nearest(found, still).real
    values = [jnp.abs(near) / (2 * jnp.pi), -near.real / jnp.abs(near), slow]
    if structure is not None:
        values += _matrices(realization, structure)
    return jnp.concatenate(values)


def _nearest(found: Complex[Array, " n"], wanted: Array) -> Complex[Array, " k"]:
    return found[jnp.argmin(jnp.abs(found - wanted[:, None]), axis=1)]


def _matrices(rz: Realization, structure: Structure) -> list[Array]:
    rows = np.array(structure.rows)
    seen = Realization(rz.A, rz.B, rz.C[rows], rz.D[rows], rz.dt, hold=rz.hold)
    patterns = (np.array(x).T if x else None for x in (structure.rigid, structure.loose))
    rigid, loose = patterns
    model = cbsi(seen, sensors=structure.kinds, collocated=structure.collocated, rigid=rigid, loose=loose)
    upper = np.triu_indices(len(rows))
    return [((x + x.T) / 2)[upper] for x in (getattr(model, name) for name in MATRICES)]
