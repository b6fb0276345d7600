"""Timings, run by `make bench`; they assert nothing about speed.

The impulse-response estimators, and the command `jaxsid identify` as a whole process, with an empty compilation cache
and with a filled one.
"""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxsid
from jaxsid.examples import systems

jax.config.update("jax_enable_x64", True)


def random_record(model: jaxsid.LumpedModel, samples: int) -> tuple[jaxsid.Record, np.ndarray]:
    """White forces, responses with 1 % noise, at 20 Hz; also as a table with the time."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=(samples, len(model.inputs)))
    y = np.asarray(
        jaxsid.simulate(model, {i.name: x for i, x in zip(model.inputs, u.T, strict=True)}, dt=0.05)
    )
    y = y + 0.01 * y.std(axis=0) * rng.normal(size=y.shape)
    names = {"inputs": [i.name for i in model.inputs], "outputs": [s.name for s in model.sensors]}
    return jaxsid.Record(u, y, 0.05, **names), np.column_stack([0.05 * np.arange(samples), u, y])


@pytest.mark.parametrize(
    "method",
    [jaxsid.Fourier(), jaxsid.Direct(), jaxsid.Wavelet(), jaxsid.InBand()],
    ids=lambda m: type(m).__name__,
)
@pytest.mark.benchmark(group="impulse response, 4096 samples")
def test_impulse_response(benchmark, method):
    record, _ = random_record(systems.one_dof(), 4096)
    run = lambda: jax.block_until_ready(jaxsid.impulse_response(record, method=method).h)  # noqa: E731
    run()
    benchmark.pedantic(run, rounds=3)


@pytest.fixture(scope="module")
def chain_files(tmp_path_factory):
    """A chain of three masses, 20 000 samples of three forces and three accelerations, as files."""
    folder = tmp_path_factory.mktemp("identify")
    model = systems.three_dof()
    record, table = random_record(model, 20_000)
    names = ["time", *record.inputs, *record.outputs]
    np.savetxt(folder / "record.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    jaxsid.write_model(model, folder / "model.toml")
    return folder


@pytest.mark.parametrize("cache", ["empty compilation cache", "filled compilation cache"])
@pytest.mark.benchmark(group="jaxsid identify, 20 000 samples, whole process")
def test_identify_process(benchmark, chain_files, cache):
    """In this order: the first fills the cache that the second uses."""
    command = [
        sys.executable,
        "-c",
        "from jaxsid.cli import app; app()",
        "identify",
        "model.toml",
        "record.csv",
    ]
    environment = os.environ | {"JAXSID_CACHE": str(chain_files / "cache")}

    def run():
        subprocess.run(
            [*command, "--out", "out", "--quiet"],
            cwd=chain_files,
            env=environment,
            check=True,
            capture_output=True,
        )

    benchmark.pedantic(run, rounds=1)
