"""Many realizations of an experiment: one compiled program over chunks, memory bounded, every result its own number."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsid.checks import require
from jaxsid.compilation import compiled

# Realizations that run side by side on an accelerator. It is part of every program and never changes, so that a
# realization gives the same bits whichever chunk, device or worker it falls to. A CPU takes one after another:
# batches are no faster there, and jaxlib's batched LAPACK calls can lock each other out (see realization/lapack.py).
BATCH = 16


def ensemble(
    function: Callable[[Array], Any],
    key: Array,
    count: int,
    *,
    first: int = 0,
    chunk: int = 1024,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Any:
    """Results of a function of a random key, for realizations `first` to `first + count - 1`.

    Realization i gets `jax.random.fold_in(key, i)`: its result does not depend on the chunk it is in, nor on how many
    devices or threads share the work. Chunks run one after another, each spread over all devices, or over the cores
    of a CPU.

    Args:
        function: of a key, to a pytree of arrays. An `equinox.Module` that is called may hold arrays: modules that
            differ only in these share one compiled program. A plain function is compiled once for as long as it
            lives.
        key: of the whole ensemble.
        count: number of realizations.
        first: number of the first.
        chunk: realizations computed before results move to the host; memory grows with it, not with `count`.
        threads: on a CPU, how many realizations run at the same time; default: one for each core.
        progress: called after each chunk with the number of realizations done.

    Returns:
        The pytree as numpy arrays, with a leading axis of `count`.

    Raises:
        InputError: a count, chunk or number of threads below 1.
    """
    require(count >= 1 and chunk >= 1, f"count and chunk must be at least 1, not {count} and {chunk}.")
    require(threads is None or threads >= 1, f"threads must be at least 1, not {threads}.")
    begin = first - first % BATCH  # batches start at multiples of BATCH, so that neighbours stay neighbours
    end = first + count
    lanes = _lanes(threads)
    # one program whatever the count: its results have room for a full chunk
    room, share = (BATCH * -(-number // (BATCH * len(lanes))) for number in (chunk, min(chunk, end - begin)))

    def run(at: int, device: Any) -> Any:
        place, number = np.asarray(at), np.asarray(min(share, end - at))
        which, start, size = jax.device_put((key, place, number), device)
        found = _share(function, which, start, size, room)
        return jax.tree.map(lambda x: np.asarray(x)[max(first - at, 0) : min(share, end - at)], found)

    parts = []
    with ThreadPoolExecutor(len(lanes)) as pool:
        for start in range(begin, end, share * len(lanes)):
            stop = min(start + share * len(lanes), end)
            parts += pool.map(run, range(start, stop, share), lanes)
            if progress is not None:
                progress(stop - first)
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _lanes(threads: int | None) -> list[Any]:
    """The device of each chunk that runs at the same time: all devices, or the one CPU once for each core."""
    devices = jax.devices()
    if len(devices) > 1 or devices[0].platform != "cpu":
        return devices
    return devices * (threads or os.cpu_count() or 1)


@compiled
def _share(function: Callable[[Array], Any], key: Array, start: Array, count: Array, room: int) -> Any:
    """Realizations from `start` on, a batch after another; after the batch of the last of `count` there are zeros."""

    def batch(at: Array) -> Any:
        draw = lambda i: function(jax.random.fold_in(key, i))  # noqa: E731
        numbers = at + jnp.arange(BATCH)
        return jax.lax.platform_dependent(
            numbers, cpu=lambda i: jax.lax.map(draw, i), default=lambda i: jax.vmap(draw)(i)
        )

    def step(i: Array, results: Any) -> Any:
        put = jax.lax.dynamic_update_slice_in_dim
        return jax.tree.map(
            lambda whole, new: put(whole, new, i * BATCH, 0), results, batch(start + i * BATCH)
        )

    shapes = jax.eval_shape(batch, start)
    blank = jax.tree.map(lambda x: jnp.zeros((room, *x.shape[1:]), x.dtype), shapes)
    return jax.lax.fori_loop(0, (count + BATCH - 1) // BATCH, step, blank)
