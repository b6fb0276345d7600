"""How many realizations a second, how much memory they take, and the delta method against Monte Carlo.

    .venv/bin/python benchmarks/rates.py OUT.json

It runs as it is on a GPU that JAX finds, from the environment with the extra `cuda`.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from era_cases import CHAIN, held_response
from era_worker import STATUS, resident, start_peak

import jaxsid

jax.config.update("jax_enable_x64", True)
KEY = jax.random.key(0)
NOISE = 0.01  # of the root mean square of the impulse response past its feedthrough
MONTE_CARLO = 10_000
MEMORY_COUNTS, MEMORY_CHUNK = (256, 4096), 64
ONE_POOL = {"MALLOC_ARENA_MAX": "1"}  # a pool of memory for each thread fills by chance, whatever the count
LATENCY_CALLS = 200


class Chain(NamedTuple):
    """From a noisy impulse response of the three masses to M, D, K.

    Attributes:
        dt: sampling interval, s.
        samples: of the impulse response.
        blocks: block rows, and block columns, of the Hankel matrix.
        stride: samples between them.
        count: realizations; the first chunks, which compile, are not timed.
        chunk: see jaxsid.ensemble.
    """

    dt: float
    samples: int
    blocks: int
    stride: int
    count: int
    chunk: int

    def response(self) -> tuple[np.ndarray, float]:
        """Without noise, and the noise's standard deviation."""
        h, _ = held_response(CHAIN, self.dt, self.samples)
        return h, NOISE * float(np.sqrt((h[1:] ** 2).mean()))

    def realization(self, h: jax.Array) -> jaxsid.Realization:
        window = {"rows": self.blocks, "cols": self.blocks, "stride": self.stride}
        return jaxsid.era(jaxsid.ImpulseResponse(h, self.dt), order=6, **window)

    def experiment(self, results: Callable) -> Callable[[jax.Array], dict[str, jax.Array]]:
        """Of a random key, for jaxsid.ensemble."""
        h, size = self.response()
        return lambda key: results(self.realization(h + size * jax.random.normal(key, h.shape)))


CHAINS = {
    "200 samples, Hankel of 40 x 40 blocks": Chain(0.1, 201, 40, 2, 5120, 256),
    "case C: 201 samples, Hankel of 100 x 100 blocks": Chain(0.02, 201, 100, 1, 1280, 128),
}
USUAL = next(iter(CHAINS.values()))


def matrices(realization: jaxsid.Realization) -> dict[str, jax.Array]:
    found = jaxsid.cbsi(realization, sensors=("acceleration",) * 3, collocated=(0, 1, 2))
    return {"M": found.mass, "D": found.damping, "K": found.stiffness}


def matrices_and_modes(realization: jaxsid.Realization) -> dict[str, jax.Array]:
    modes = jaxsid.modal(realization)
    frequencies = {"frequencies": modes.frequencies, "damping ratios": modes.damping_ratios}
    return matrices(realization) | frequencies


def rate(chain: Chain) -> float:
    """Realizations a second once the program is compiled: from the end of the first chunks to that of the last."""
    seen: list[tuple[int, float]] = []
    jaxsid.ensemble(
        chain.experiment(matrices),
        KEY,
        chain.count,
        chunk=chain.chunk,
        progress=lambda done: seen.append((done, time.perf_counter())),
    )
    (few, begin), (every, end) = seen[0], seen[-1]
    return (every - few) / (end - begin)


def ensemble_peak(count: int) -> float | None:
    """Highest memory of an ensemble above that after its first chunks, which compile, MB."""
    if not STATUS.exists():
        return None
    start: list[float] = []
    jaxsid.ensemble(
        USUAL.experiment(matrices),
        KEY,
        count,
        chunk=MEMORY_CHUNK,
        progress=lambda _: start or start.append(start_peak()),
    )
    return resident("VmHWM") - start[0]


def memory() -> dict[str, float | None]:
    """For each number of realizations, in a process of its own."""
    peaks = {}
    for count in MEMORY_COUNTS:
        command = [sys.executable, __file__, "--memory", str(count)]
        done = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | ONE_POOL
        )
        peaks[str(count)] = json.loads(done.stdout)
    return peaks


def latencies(runs: list[Callable[[], object]]) -> list[float]:
    """Median times of calls that take turns and have been called before, s."""
    seconds = [[] for _ in runs]
    for turn in range(1 + LATENCY_CALLS):
        for run, mine in zip(runs, seconds, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(run())
            if turn:
                mine.append(time.perf_counter() - begin)
    return [statistics.median(mine) for mine in seconds]


def delta_method() -> dict[str, float]:
    """Time of a realization with its covariance over that without; deviations over those of Monte Carlo."""
    h, size = USUAL.response()
    noise = jaxsid.IndependentNoise(jnp.full(h.shape, size**2))

    def spread(h: jax.Array):
        found = jaxsid.propagate(matrices_and_modes, USUAL.realization(h), noise, samples=len(h))
        return found.value, found.deviation

    plain, spread = jax.jit(lambda h: matrices_and_modes(USUAL.realization(h))), jax.jit(spread)
    one, both = latencies([lambda: plain(h), lambda: spread(h)])
    drawn = jaxsid.ensemble(USUAL.experiment(matrices_and_modes), KEY, MONTE_CARLO)
    ratios = jax.tree.map(lambda mine, theirs: np.asarray(mine) / theirs.std(axis=0), spread(h)[1], drawn)
    off = {name: float(np.abs(x - 1).max()) for name, x in ratios.items()}
    return {"one realization, s": one, "with covariance, s": both, "worst deviation": max(off.values())}


def main() -> None:
    if sys.argv[1] == "--memory":
        print(json.dumps(ensemble_peak(int(sys.argv[2]))))
        return
    device = jax.devices()[0]
    found = {
        "device": device.device_kind,
        "platform": device.platform,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "rates": {words: rate(chain) for words, chain in CHAINS.items()},
        "memory": memory(),
        "delta method": delta_method(),
    }
    with open(sys.argv[1], "w") as file:
        json.dump(found, file)


if __name__ == "__main__":
    main()
