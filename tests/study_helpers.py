"""Small studies whose experiments compile at once, also on workers, which import this file."""

import dataclasses
import json
import os
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq

from jaxsid.study.configuration import Case, Study
from jaxsid.study.engine import run_study
from jaxsid.study.store import open_store
from jaxsid.study.tables import write_tables

NAMES = ("frequency_1", "frequency_2", "mass_1_1")


class Guess(eqx.Module):
    """Truth and Gaussian noise, through an eigenvalue problem; one draw in ten of the third quantity fails."""

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    truth: jax.Array
    bound: jax.Array

    def __call__(self, key):
        noise, luck = jax.random.split(key)
        draw = self.bound * jax.random.normal(noise, (3,))
        x = jnp.linalg.eigvalsh(jnp.diag(self.truth) + 1e-3 * draw[:, None] * draw[None, :]) + draw
        return x.at[2].set(jnp.where(jax.random.uniform(luck) < 0.1, jnp.nan, x[2]))


def make(case):
    """The experiment of a case with a number `noise`."""
    truth = jnp.array([1.0, 2.0, 4.0])
    return Guess(NAMES, ("Hz", "Hz", "kg"), truth, case.values["noise"] * truth)


def study(realizations=100, chunk=16, noise=(0.01, 0.1), name="small", **other):
    """Cases that differ in `noise` and in `algorithm`, which has no effect."""
    cases = [{"noise": x, "algorithm": y, "rows": 7, **other} for y in ("a", "b") for x in noise]
    source = json.dumps({"seed": 3, "factors": {"noise": noise, **other}})
    made = tuple(Case(i, values) for i, values in enumerate(cases))
    return Study(name, 3, realizations, chunk, made, ("noise", "algorithm"), source)


def rechunked(plan, **changes):
    return dataclasses.replace(plan, **changes)


def run(plan, folder, **options):
    """Run a study to its end; its summary."""
    with open_store(folder, plan) as store:
        run_study(plan, store, make=make, **options)
        return write_tables(plan, store)


def results(folder):
    """All bytes of the tables."""
    return {
        name: (folder / name).read_bytes() for name in ("results.parquet", "summary.parquet", "summary.csv")
    }


def numbers(folder, case):
    """Numbers of the realizations in the parts of a case, in the order of the files."""
    files = sorted((folder / "parts" / f"case-{case:05d}").glob("*.parquet"))
    return np.concatenate([pq.read_table(file)["number"].to_numpy() for file in files])


def environment(tests=Path(__file__).parent):
    """Of a process that can import this file."""
    return os.environ | {"PYTHONPATH": str(tests), "TF_CPP_MIN_LOG_LEVEL": "3"}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    run(study(int(sys.argv[2])), Path(sys.argv[1]))
