"""Places that records cannot tell apart: how much evidence one would gain over another if the effect were there.

If place a holds the truth and leaves the lines r_a, noise aside, place b explains what it can of them by parameters
within their tolerance, transients, its own shapes and its process. The expected difference of the logarithms of
evidence, D(a|b) = log p_a(r_a) - log p_b(r_a), says whether these records could tell, however well either fits them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float

from jaxsid.compilation import compiled
from jaxsid.gap.evidence import Force, Table, absorbed, density, evidence, table
from jaxsid.gap.places import Place
from jaxsid.gap.ports import Explained, Guess, Ports, columns_of, transfers_of
from jaxsid.gap.setting import Setting
from jaxsid.mechanics.lumped import GROUND, LumpedModel

COMPARED = 6  # most probable places that are compared with one another


class Hypotheses(NamedTuple):
    """What was tried at every place.

    Attributes:
        ports: the places.
        guesses: of each record, a row a place.
        force: processes (places, h).
        priors: (places, variants, k) of the coefficients.
    """

    ports: Ports
    guesses: tuple[Guess, ...]
    force: Force
    priors: Float[np.ndarray, "places variants k"]


def expected_differences(
    settings: Sequence[Setting], tried: Hypotheses, each: Sequence[Explained], rows: np.ndarray
) -> Float[np.ndarray, "a b"]:
    """D(a|b) of some places, all records together.

    Args:
        settings: of each record.
        tried: hypotheses of every place.
        each: what the places make of each record.
        rows: which places.
    """
    ports, guesses, force = jax.tree.map(lambda x: x[rows], (tried.ports, tried.guesses, tried.force))
    parts = [
        _tables(s, ports, g, force, (s.spectra.y - s.spectra.response) - x.left[rows])
        for s, g, x in zip(settings, guesses, each, strict=True)
    ]
    found, gained = jax.tree.map(lambda *x: sum(x[1:], start=x[0]), *parts)
    count = len(rows)
    k = found.gram.shape[2] - count
    value = np.empty((count, count))
    for a in range(count):
        kept = np.array([*range(k), k + a])
        own = Table(found.gram[:, :, kept][:, :, :, kept], found.log_determinant)
        # noise that a process takes up speaks for it, as it does in measured lines
        each_one = evidence(own, tried.priors[rows]).value + np.asarray(gained)[:, None]
        value[a] = each_one.reshape(count, -1).max(axis=1)
    return np.diag(value)[:, None] - value


@compiled
def _tables(
    given: Setting, ports: Ports, guess: Guess, force: Force, left: Complex[Array, "a lines outputs"]
) -> tuple[Table, Array]:
    """Tables of every place with the lines of all of them in the place of the data, and the noise taken up."""
    spectra, data = given.spectra, jnp.moveaxis(left, 0, -1)

    def one(row: tuple[Ports, Guess, Force]) -> tuple[Table, Array]:
        port, guess, force = row
        columns = jnp.concatenate([columns_of(given, port, guess.motion, guess.size), data], axis=2)
        plain, _ = transfers_of(spectra, port)
        densities = density(force, spectra.omega, spectra.dt)
        found = table(columns, spectra.free, plain, given.scale, densities, given.transient)
        return found, absorbed(plain, given.scale, densities)

    return lax.map(one, (ports, guess, force))


def same_force(model: LumpedModel, places: Sequence[Place]) -> Bool[np.ndarray, "places places"]:
    """Which places bear the same force: an input, and the ground force on the body that it drives.

    Args:
        model: says where inputs act.
        places: rows and columns of the result.
    """
    driven = {i.name: i.body for i in model.inputs}
    body = [
        driven[p.ends[0]] if p.where == "input" else p.ends[1] if p.ends[0] == GROUND else "" for p in places
    ]
    one = [any(p.where == "input" and b == c for p, c in zip(places, body, strict=True)) for b in body]
    return np.array(
        [
            [i == j or (a == b != "" and told) for j, b in enumerate(body)]
            for i, (a, told) in enumerate(zip(body, one, strict=True))
        ]
    )


def sets_of(order: Sequence[int], alike: Bool[np.ndarray, "places places"]) -> list[tuple[int, ...]]:
    """The set of every place, most probable first: each of them gathers those left that are like it.

    Args:
        order: places, most probable first.
        alike: [a, b] whether b is not told apart from a.
    """
    found: list[tuple[int, ...]] = [()] * len(order)
    free = list(order)
    while free:
        chosen = tuple(b for b in free if b == free[0] or alike[free[0], b])
        for b in chosen:
            found[b] = chosen
        free = [b for b in free if b not in chosen]
    return found
