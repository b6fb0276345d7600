"""Many realizations of an experiment: one compiled program over chunks, memory bounded, every result its own number."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsid.checks import require

# Realizations that run side by side. It is part of every compiled program and never changes, so that a realization
# gives the same bits whichever chunk, device or worker it falls to.
BATCH = 16


def ensemble(
    function: Callable[[Array], Any],
    key: Array,
    count: int,
    *,
    first: int = 0,
    chunk: int = 1024,
    progress: Callable[[int], None] | None = None,
) -> Any:
    """Results of a function of a random key, for realizations `first` to `first + count - 1`.

    Realization i gets `jax.random.fold_in(key, i)`: its result does not depend on the chunk it is in, nor on how many
    devices share the work. Chunks run one after another, each spread over all devices.

    Args:
        function: of a key, to a pytree of arrays; traced once.
        key: of the whole ensemble.
        count: number of realizations.
        first: number of the first.
        chunk: realizations computed before results move to the host; memory grows with it, not with `count`.
        progress: called after each chunk with the number of realizations done.

    Returns:
        The pytree as numpy arrays, with a leading axis of `count`.

    Raises:
        InputError: a count or chunk below 1.
    """
    require(count >= 1 and chunk >= 1, f"count and chunk must be at least 1, not {count} and {chunk}.")
    begin = first - first % BATCH  # batches start at multiples of BATCH, so that neighbours stay neighbours
    end = first + count
    devices = jax.devices()
    size = BATCH * max(1, min(chunk, end - begin) // (BATCH * len(devices)))
    run = jax.jit(lambda start: _share(function, key, start, size))
    parts = []
    for start in range(begin, end, size * len(devices)):
        # the same program on every device: they work side by side, since calls do not wait
        pieces = [
            run(jax.device_put(np.asarray(start + i * size), device))
            for i, device in enumerate(devices)
            if start + i * size < end
        ]
        for i, piece in enumerate(pieces):
            at = start + i * size
            low, high = max(first - at, 0), min(end - at, size)
            parts.append(jax.tree.map(lambda x, a=low, b=high: np.asarray(x)[a:b], piece))
        if progress is not None:
            progress(min(start + size * len(devices), end) - first)
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _share(function: Callable[[Array], Any], key: Array, start: Array, size: int) -> Any:
    """Realizations from `start` on, a batch after another, vectorized within a batch."""
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(start + jnp.arange(size))
    return jax.lax.map(function, keys, batch_size=BATCH)
