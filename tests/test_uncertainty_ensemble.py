"""Ensembles: the same realizations whatever the chunk, the start or the number of devices; memory does not grow."""

import os
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsid
from jaxsid.checks import InputError
from jaxsid.examples.systems import three_dof
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.hold import discretise
from jaxsid.mechanics.lumped import second_order
from jaxsid.mechanics.simulate import markov_parameters
from jaxsid.uncertainty.ensemble import ensemble


def experiment():
    """From a key to M, D, K of the 3 DOF chain, by ERA of a noisy impulse response."""
    model = physical_displacement_velocity(second_order(three_dof()))
    h = markov_parameters(discretise(model, 0.1), samples=100)
    size = 0.01 * h.std()

    def one(key):
        ir = jaxsid.ImpulseResponse(h + size * jax.random.normal(key, h.shape), 0.1)
        rz = jaxsid.era(ir, order=6, rows=30, cols=30)
        so = jaxsid.cbsi(rz, sensors=("acceleration",) * 3, collocated=(0, 1, 2))
        return {"mass": so.mass, "stiffness": so.stiffness}

    return one


KEY = jax.random.key(7)


@pytest.mark.slow
def test_any_chunk_and_any_start_give_the_same_bits():
    one = experiment()
    whole = ensemble(one, KEY, 70, chunk=1000)
    assert whole["mass"].shape == (70, 3, 3)
    for chunk in (1, 48):
        parts = ensemble(one, KEY, 70, chunk=chunk)
        np.testing.assert_array_equal(parts["mass"], whole["mass"])
    for first, count in ((21, 30), (64, 6)):
        part = ensemble(one, KEY, count, first=first, chunk=32)
        np.testing.assert_array_equal(part["stiffness"], whole["stiffness"][first : first + count])


class Noisy(eqx.Module):
    """A number in noise; counts how often it is traced."""

    level: jax.Array
    traces: ClassVar[list[int]] = []

    def __call__(self, key):
        self.traces.append(1)
        return self.level * jax.random.normal(key)


def test_modules_that_differ_in_numbers_share_a_program():
    quiet, loud = (Noisy(jnp.asarray(level)) for level in (0.1, 1.0))
    first = ensemble(quiet, KEY, 40, chunk=16)
    traced = len(Noisy.traces)
    np.testing.assert_allclose(ensemble(loud, KEY, 40, chunk=16), 10 * first, rtol=1e-12)
    np.testing.assert_array_equal(ensemble(quiet, KEY, 5, first=32, chunk=16), first[32:37])
    assert len(Noisy.traces) == traced


def test_it_is_the_loop():
    one = experiment()
    got = ensemble(one, KEY, 3, first=40)
    for i in range(3):
        alone = one(jax.random.fold_in(KEY, 40 + i))
        np.testing.assert_allclose(got["mass"][i], alone["mass"], rtol=1e-9, atol=1e-9)


def test_realizations_differ_and_scatter_around_the_truth():
    got = ensemble(experiment(), KEY, 64)
    assert len(np.unique(got["mass"][:, 0, 0])) == 64
    error = got["mass"].mean(axis=0) - np.eye(3)
    assert np.abs(error).max() < 4 * got["mass"].std(axis=0).max() / 8


def test_progress_counts_up():
    told = []
    ensemble(lambda key: jax.random.normal(key), KEY, 50, first=3, chunk=16, progress=told.append)
    assert told[-1] == 50
    assert told == sorted(told)


def test_refuses():
    with pytest.raises(InputError, match="count"):
        ensemble(lambda key: jnp.zeros(()), KEY, 0)


@pytest.mark.slow
def test_several_devices_give_the_same_bits(tmp_path: Path):
    script = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import numpy as np
sys.path.insert(0, sys.argv[1])
from test_uncertainty_ensemble import KEY, experiment
from jaxsid.uncertainty.ensemble import ensemble
np.save(sys.argv[2], ensemble(experiment(), KEY, 40, first=9)["mass"])
print(jax.device_count())
"""
    folder = os.path.dirname(__file__)
    results = []
    for devices in ("1", "4"):
        environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"}
        path = str(tmp_path / f"{devices}.npy")
        done = subprocess.run(
            [sys.executable, "-c", script, folder, path], env=environment, capture_output=True, text=True
        )
        assert done.stdout.strip() == devices, done.stderr
        results.append(np.load(path))
    np.testing.assert_array_equal(results[0], results[1])
