"""QR, singular value and eigenvalue decompositions of batches, one at a time on CPU.

jaxlib's batched LAPACK calls on CPU wait, inside the thread pool, for other threads of it; two of them at
once, or one and a Fourier transform, can lock each other out for good on a machine of few cores. A loop
cannot, and is hardly slower there. Accelerators keep the batched routines.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def one_at_a_time(decompose: Callable[[jax.Array], Any]) -> Callable[[jax.Array], Any]:
    """The same function of one matrix, looping over the batch on CPU under vmap; forward evaluation only."""
    single = jax.custom_batching.custom_vmap(decompose)

    @single.def_vmap
    def _loop(_: int, __: list[bool], matrices: jax.Array) -> tuple[Any, Any]:
        results = jax.lax.platform_dependent(
            matrices, cpu=lambda x: jax.lax.map(single, x), default=jax.vmap(decompose)
        )
        return results, jax.tree.map(lambda _: True, results)

    return single


qr = one_at_a_time(lambda x: tuple(jnp.linalg.qr(x)))
svd = one_at_a_time(lambda x: tuple(jnp.linalg.svd(x, full_matrices=False)))
eigh = one_at_a_time(lambda x: tuple(jnp.linalg.eigh(x)))
