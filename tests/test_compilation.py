"""Programs kept on disk: the same numbers, found again, and never trusted when damaged or when they do not fit."""

import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsid.compilation
from jaxsid import InputError, diagnose, identify
from jaxsid.compilation import compiled, keep_programs, release_programs
from jaxsid.examples.systems import three_dof
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import second_order


class Pair(NamedTuple):
    values: jax.Array
    name: str


class Traces:
    """A function that counts how often it is traced, wrapped anew as another process would."""

    def __init__(self):
        self.count = 0

    def fresh(self):
        def eigenvalues(a, scale, *, power: int = 1, word: str = "none"):
            self.count += 1
            return Pair(jnp.linalg.eigvals(a * scale) ** power, word), power

        return compiled(eigenvalues)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    before = jax.config.jax_compilation_cache_dir
    keep_programs(tmp_path / "cache")
    yield tmp_path / "cache" / "programs"
    keep_programs(None)
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture
def matrix() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(5, 5))


def test_programs_compiled_in_a_hurry_are_kept_apart_and_give_the_same(folder: Path, matrix: np.ndarray):
    traces = Traces()
    careful = traces.fresh()(matrix, jnp.asarray(2.0))
    keep_programs(folder.parent, hurry=True)
    hurried = traces.fresh()(matrix, jnp.asarray(2.0))
    assert (traces.count, len(list(folder.iterdir()))) == (2, 2)
    np.testing.assert_allclose(hurried[0].values, careful[0].values, rtol=1e-12)


def test_a_second_process_reads_what_the_first_compiled(folder: Path, matrix: np.ndarray):
    traces = Traces()
    first = traces.fresh()(matrix, jnp.asarray(2.0), power=2, word="kept")
    second = traces.fresh()(matrix, jnp.asarray(2.0), power=2, word="kept")
    assert traces.count == 1
    assert (second[0].name, second[1]) == (first[0].name, first[1]) == ("kept", 2)
    np.testing.assert_array_equal(second[0].values, first[0].values)
    expected = np.linalg.eigvals(2 * matrix) ** 2
    np.testing.assert_allclose(np.sort_complex(first[0].values), np.sort_complex(expected), rtol=1e-10)


def test_other_options_shapes_and_types_are_other_programs(folder: Path, matrix: np.ndarray):
    traces = Traces()
    run = traces.fresh()
    scale = jnp.asarray(2.0)
    for arguments in (
        (matrix, scale),
        (matrix[:3, :3], scale),
        (matrix.astype("float32"), scale),
        (matrix, 3.0),
    ):
        before = traces.count
        got, _ = run(*arguments)
        assert traces.count == before + 1
        expected = np.linalg.eigvals(np.asarray(arguments[0], float) * float(arguments[1]))
        np.testing.assert_allclose(np.sort_complex(got.values), np.sort_complex(expected), rtol=1e-4)
    run(matrix, 4.0)  # a plain number is static
    assert traces.count == 5
    with jax.debug_nans(True):
        run(matrix, scale)
    assert traces.count == 6


def test_a_call_like_one_before_is_not_named_again(
    folder: Path, matrix: np.ndarray, monkeypatch: pytest.MonkeyPatch
):
    traces = Traces()
    run, named, name = traces.fresh(), [], jaxsid.compilation._key
    monkeypatch.setattr(jaxsid.compilation, "_key", lambda *x: named.append(x) or name(*x))
    for scale in (2.0, 3.0, 4.0):
        got = run(matrix, jnp.asarray(scale), word="kept")[0].values
        expected = np.linalg.eigvals(scale * matrix)
        np.testing.assert_allclose(np.sort_complex(got), np.sort_complex(expected), rtol=1e-10)
    assert (len(named), traces.count) == (1, 1)


def test_numbers_that_are_equal_but_not_the_same_are_other_programs(folder: Path):
    def signed(x, given):
        return jnp.copysign(x, given) if isinstance(given, float) else x + jnp.asarray(given)

    run, x = compiled(signed), jnp.asarray([3])
    found = [(float(y[0]), y.dtype.kind) for y in (run(x, given) for given in (0.0, -0.0, 0, 1, 1.0, True))]
    assert found == [(3.0, "f"), (-3.0, "f"), (3.0, "i"), (4.0, "i"), (3.0, "f"), (4.0, "i")]


def test_a_traced_call_goes_through(folder: Path, matrix: np.ndarray):
    run = Traces().fresh()
    scales = jnp.asarray([1.0, 2.0])
    got = jax.vmap(lambda s: run(matrix, s)[0].values)(scales)
    expected = np.stack([np.linalg.eigvals(matrix * s) for s in (1.0, 2.0)])
    np.testing.assert_allclose(np.sort_complex(got), np.sort_complex(expected), rtol=1e-10)
    assert not list(folder.glob("*"))
    slope = jax.grad(lambda s: jnp.abs(run(matrix, s)[0].values).sum())(jnp.asarray(2.0))
    np.testing.assert_allclose(slope, np.abs(np.linalg.eigvals(matrix)).sum(), rtol=1e-10)


@pytest.mark.parametrize("damage", [b"", b"short", None])
def test_a_damaged_file_is_compiled_anew(folder: Path, matrix: np.ndarray, damage: bytes | None):
    traces = Traces()
    traces.fresh()(matrix, jnp.asarray(2.0))
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[:-9] if damage is None else damage)
    traces.fresh()(matrix, jnp.asarray(2.0))
    assert traces.count == 2
    traces.fresh()(matrix, jnp.asarray(2.0))
    assert traces.count == 2


def test_other_sources_are_other_programs(folder: Path, matrix: np.ndarray, monkeypatch: pytest.MonkeyPatch):
    traces = Traces()
    traces.fresh()(matrix, jnp.asarray(2.0))
    kept = jaxsid.compilation._kept
    assert kept is not None
    monkeypatch.setattr(jaxsid.compilation, "_kept", kept._replace(stamp=b"another version"))
    traces.fresh()(matrix, jnp.asarray(2.0))
    assert traces.count == 2


def test_a_folder_that_cannot_be_written_to_is_no_error(tmp_path: Path, folder: Path, matrix: np.ndarray):
    (tmp_path / "file").write_text("in the way")
    keep_programs(tmp_path / "file")
    jax.config.update("jax_compilation_cache_dir", None)
    got, _ = Traces().fresh()(matrix, jnp.asarray(1.0))
    np.testing.assert_allclose(
        np.sort_complex(got.values), np.sort_complex(np.linalg.eigvals(matrix)), rtol=1e-10
    )


def test_the_programs_unused_for_longest_go(
    folder: Path, matrix: np.ndarray, monkeypatch: pytest.MonkeyPatch
):
    run = Traces().fresh()
    run(matrix, jnp.asarray(1.0))
    (first,) = folder.iterdir()
    monkeypatch.setattr(jaxsid.compilation, "MOST_BYTES", 2.5 * first.stat().st_size)
    for n in (4, 3, 2):
        run(matrix[:n, :n], jnp.asarray(1.0))
    assert len(list(folder.iterdir())) == 2
    assert not first.exists()


def test_released_programs_come_back_from_disk(folder: Path, matrix: np.ndarray):
    traces = Traces()
    run = traces.fresh()
    first = run(matrix, jnp.asarray(1.0))[0].values
    release_programs(10**9)
    run(matrix, jnp.asarray(1.0))
    maps = memory_maps()
    release_programs(0)
    assert memory_maps() < maps
    count = traces.count
    np.testing.assert_array_equal(run(matrix, jnp.asarray(1.0))[0].values, first)
    assert traces.count == count


@pytest.mark.parametrize("begun", [identify, diagnose])
def test_long_work_releases_the_programs_of_other_sizes(begun, monkeypatch):
    released = []
    module = sys.modules[begun.__module__]
    monkeypatch.setattr(module, "release_programs", lambda: released.append(True))
    with pytest.raises(InputError):
        begun(three_dof(), [])
    assert released == [True]


def test_threads_that_begin_together_share_a_program(folder: Path, matrix: np.ndarray):
    """Compiled once, and unseen by JAX's own cache: what came from there could not be kept."""
    traces, start = Traces(), threading.Barrier(4)
    run = traces.fresh()

    def call(_: int):
        start.wait()
        return run(matrix, jnp.asarray(3.0))[0].values

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(call, range(4))
    for other in others:
        np.testing.assert_array_equal(other, first)
    assert traces.count == 1
    assert not list(folder.parent.glob("jit_own_*"))
    assert len(list(folder.iterdir())) == 1
    np.testing.assert_array_equal(traces.fresh()(matrix, jnp.asarray(3.0))[0].values, first)


def memory_maps() -> int:
    return Path("/proc/self/maps").read_text().count("\n")


def test_a_callable_argument_is_compiled_but_not_kept(folder: Path):
    apply = compiled(lambda function, x: function(x))
    np.testing.assert_allclose(apply(lambda x: x + 1, jnp.ones(3)), 2.0)
    assert not list(folder.glob("*"))


def test_what_another_module_defines_is_compiled_but_not_kept(folder: Path, matrix: np.ndarray):
    """Its source may change while its name stays."""
    double = compiled(lambda pair: pair.values * 2)
    np.testing.assert_array_equal(double(Pair(jnp.asarray(matrix), "foreign")), 2 * matrix)
    assert not list(folder.glob("*"))


def test_random_keys_go_in(folder: Path):
    draw = lambda: compiled(lambda key: jax.random.normal(key, (3,)))  # noqa: E731
    first = draw()(jax.random.key(3))
    assert len(list(folder.iterdir())) == 1
    np.testing.assert_array_equal(draw()(jax.random.key(3)), first)
    np.testing.assert_array_equal(first, jax.random.normal(jax.random.key(3), (3,)))


def test_records_go_in_and_come_out(folder: Path):
    model = second_order(three_dof())
    kept = physical_displacement_velocity(model)
    keep_programs(None)
    np.testing.assert_array_equal(kept.A, physical_displacement_velocity(model).A)
    assert list(folder.iterdir())
