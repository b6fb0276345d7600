"""Shared settings and fixtures: double precision, the data path, a compilation cache."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

# XLA logs an error line for each program read back from the cache, over two tuning flags of its own.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# Most of a run is compilation, which the command, too, does in a hurry; `make test-all` optimizes in full.
if not os.environ.get("JAXSID_OPTIMIZED"):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"

import jax
import pytest

from jaxsid.compilation import keep_programs

ROOT = Path(__file__).parents[1]

jax.config.update("jax_enable_x64", True)

# Most of a run is compilation; a second run reads it from a git-ignored folder, which `make clean` removes.
# In continuous integration there is no second run, and writing to the cache has crashed a worker once.
if not os.environ.get("CI"):
    jax.config.update("jax_compilation_cache_dir", str(ROOT / ".pytest_cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


MOST_MAPPED = 20_000  # of the 65 530 pieces of memory that Linux lets a process map


def _mapped() -> float:
    """How many pieces of memory this process has mapped: each compiled program is a few; not told outside Linux."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else math.inf


@pytest.fixture(autouse=True, scope="module")
def release_programs() -> Iterator[None]:
    """Drop compiled programs when a file is done and many are there: thousands of them exhaust a process.

    The command switches its own cache on; what was set before comes back.
    """
    folder = jax.config.jax_compilation_cache_dir
    yield
    keep_programs(None)
    jax.config.update("jax_compilation_cache_dir", folder)
    if _mapped() > MOST_MAPPED:
        jax.clear_caches()


@pytest.fixture
def single_precision() -> Iterator[None]:
    """Run the test in float32, as a user who has not switched on double precision does."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of measured records, which are public but not ours to publish."""
    folder = Path(os.environ.get("JAXSID_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("measured records not found; name their folder by the environment variable JAXSID_DATA")
    return folder
