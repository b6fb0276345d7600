"""Jitted functions whose programs outlive the process: a second run neither traces, lowers nor compiles.

JAX's own cache keeps what XLA compiled, yet every process traces and lowers anew, which takes longer than most of
the computing here. With a folder named by `keep_programs` whole executables are kept as well.
"""

import functools
import hashlib
import io
import os
import pickle
import platform
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax.experimental import serialize_executable

P = ParamSpec("P")
T = TypeVar("T")
MOST_BYTES = 500_000_000  # what the folder may hold before the programs unused for longest go
FULL: dict[str, bool | str | int] = {"xla_backend_optimization_level": 3}
HURRIED: dict[str, bool | str | int] = {"xla_backend_optimization_level": 0}
SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion", "jax_debug_nans")
LEAST_TIME = "jax_persistent_cache_min_compile_time_secs"
BUILT_ON = ("jax", "jaxlib", "equinox", "numpy", "scipy")
LASTING = ("jaxsid", "builtins", *BUILT_ON)


class _Folder(NamedTuple):
    path: Path
    stamp: bytes
    options: dict[str, bool | str | int]


class _Program(NamedTuple):
    """An executable over flat arrays, and its result with a `_Place` for every array."""

    run: Callable[..., list[jax.Array]]
    result: Any


@dataclass(frozen=True)
class _Place:
    index: int


_kept: _Folder | None = None
_one_at_a_time = threading.RLock()  # compiling changes a setting of the whole process
_in_memory: list[dict[Any, _Program]] = []  # of each compiled function


def keep_programs(folder: str | Path | None, *, hurry: bool = False) -> None:
    """Keep compiled programs in a folder from now on, or no longer if None.

    Programs of this library are named by its sources, the versions of what it is built on, the processor, JAX's
    settings, and the shapes and options of each call; what does not match is compiled anew. They are kept on
    machines whose one device is a CPU. What else is compiled goes to JAX's own cache, in the same folder. Like
    every cache of executables it must be a folder that nobody else can write to.

    Where XLA, as it loads them, warns of features such as `prefer-no-gather` that the machine lacks, these are
    preferences, not instructions; TF_CPP_MIN_LOG_LEVEL=3 in the environment, as the command sets it, leaves that out.

    Args:
        folder: made when the first program is written. A folder that cannot be written to is no error.
        hurry: compile with few optimizations, in three quarters of the time, for programs that run only a few times.
    """
    global _kept
    if folder is None:
        _kept = None
        return
    _kept = _Folder(Path(folder) / "programs", source_stamp(), HURRIED if hurry else {})
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update(LEAST_TIME, 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def default_folder() -> Path:
    """Where the command keeps its programs: $JAXSID_CACHE, or `jaxsid` in the user's cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("JAXSID_CACHE") or home / "jaxsid")


def release_programs(most_maps: int = 20_000) -> None:
    """Drop the programs that are in memory once they take many memory maps.

    A program takes hundreds, and Linux ends a process that asks for more than 65530. Elsewhere nothing happens.

    Args:
        most_maps: that may stay.
    """
    try:
        maps = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return
    if maps > most_maps:
        for programs in _in_memory:
            programs.clear()
        jax.clear_caches()


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """As `equinox.filter_jit`: arrays are traced, all else is static; kept on disk after `keep_programs`."""
    return _kept_on_disk(function, {})


def compiled_in_full(function: Callable[P, T]) -> Callable[P, T]:
    """As `compiled`, with all optimizations even in a hurry: for programs that run long or many times."""
    return _kept_on_disk(function, FULL)


def _kept_on_disk(function: Callable[P, T], own: dict[str, bool | str | int]) -> Callable[P, T]:
    jitted = eqx.filter_jit(function)
    programs: dict[bytes, _Program] = {}
    # the same by the calls themselves: to name one takes as long as many of them run
    called: dict[Any, _Program] = {}
    _in_memory.extend((programs, called))

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if _kept is None:
            return jitted(*args, **kwargs)
        leaves, tree = jax.tree.flatten((args, kwargs))
        if any(isinstance(x, jax.core.Tracer) for x in leaves):
            return jitted(*args, **kwargs)
        options = {**_kept.options, **own}
        settings = _settings(options)
        alike = (tree, tuple(map(_seen, leaves)), settings, _kept.stamp)
        try:
            program = called.get(alike)
        except (TypeError, ValueError):  # what cannot be hashed or compared goes by its name alone
            alike = program = None
        if program is None:
            key = _key(function, leaves, tree, settings, _kept.stamp)
            if key is None:
                return jitted(*args, **kwargs)
            path = _kept.path / key.hex()
            with _one_at_a_time:
                program = programs.get(key) or _read(path) or _compile(function, leaves, tree, path, options)
                programs[key] = program
            if alike is not None:
                called[alike] = program
        outputs = program.run(*(x for x in leaves if eqx.is_array(x)))
        return jax.tree.map(lambda x: outputs[x.index] if isinstance(x, _Place) else x, program.result)

    return call


def _settings(options: dict[str, bool | str | int]) -> tuple[Any, ...]:
    """What a program depends on besides its sources and the call."""
    names = (getattr(jax.config, name) for name in SETTINGS)
    return (jax.default_backend(), *names, os.environ.get("XLA_FLAGS"), tuple(options.items()))


def _seen(x: Any) -> Any:
    """What is equal for leaves of one program."""
    if not eqx.is_array(x):
        return type(x), x, repr(x) if isinstance(x, float) else ""  # zero and its negative are equal
    return x.aval if isinstance(x, jax.Array) else (x.shape, x.dtype)


def _key(
    function: Callable, leaves: list, tree: Any, settings: tuple[Any, ...], stamp: bytes
) -> bytes | None:
    """Name of the program for this call; None where an argument has no name that lasts."""
    if settings[0] != "cpu" or jax.device_count() > 1:
        return None
    described = [_Described(x) if eqx.is_array(x) else x for x in leaves]
    stream = io.BytesIO()
    pickler = _Namer(stream)
    pickler.fast = True  # without a memo, so that equal values give equal bytes
    try:
        pickler.dump(
            (function.__module__, function.__qualname__, settings, jax.tree.unflatten(tree, described))
        )
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError):
        return None
    return hashlib.sha256(stamp + stream.getvalue()).digest()


class _Namer(pickle.Pickler):
    """Refuses functions and classes from elsewhere: their source may change without their name."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | FunctionType) and (obj.__module__ or "").partition(".")[0] not in LASTING:
            raise pickle.PicklingError(f"{obj} is not ours")
        return NotImplemented


class _Described:
    """Shape and type of an array, for the name of a program."""

    def __init__(self, x: Any):
        kind = jax.typeof(x)
        self.kind = (kind.shape, kind.dtype.name, kind.weak_type)


@functools.cache
def source_stamp() -> bytes:
    """All that a program depends on besides the call."""
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(source.read_bytes())
    try:
        processor = next(x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("flags"))
    except (OSError, StopIteration):
        processor = platform.processor()
    digest.update(repr((processor, platform.platform(), platform.python_version())).encode())
    digest.update(repr([version(name) for name in BUILT_ON]).encode())
    return digest.digest()


def _compile(function: Callable, leaves: list, tree: Any, path: Path, options: dict) -> _Program:
    found: list[Any] = []

    def flat(*arrays: jax.Array) -> list[Any]:
        given = iter(arrays)
        args, kwargs = jax.tree.unflatten(tree, [next(given) if eqx.is_array(x) else x for x in leaves])
        results, result_tree = jax.tree.flatten(function(*args, **kwargs))
        outputs = [x for x in results if eqx.is_array(x)]
        places = iter(range(len(outputs)))
        found.append(
            jax.tree.unflatten(result_tree, [_Place(next(places)) if eqx.is_array(x) else x for x in results])
        )
        return outputs

    # a program that came from JAX's own cache cannot be written again: this name is not found there, nor put there
    flat.__name__ = f"own_{getattr(function, '__name__', 'function')}"
    arrays = [x for x in leaves if eqx.is_array(x)]
    with _unseen_by_jax():
        run = jax.jit(flat).lower(*arrays).compile(options)
    program = _Program(run, found[0])
    try:
        payload = serialize_executable.serialize(run)[0]
        body = pickle.dumps((payload, len(arrays), run.out_tree.num_leaves, program.result))
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, NotImplementedError):
        return program
    _write(path, hashlib.sha256(body).digest() + body)
    return program


@contextmanager
def _unseen_by_jax() -> Iterator[None]:
    """JAX's own cache takes only what took longest to compile: for a while, nothing."""
    before = getattr(jax.config, LEAST_TIME)
    jax.config.update(LEAST_TIME, float("inf"))
    try:
        yield
    finally:
        jax.config.update(LEAST_TIME, before)


def _read(path: Path) -> _Program | None:
    """A kept program; None where there is none, or a damaged one."""
    try:
        content = path.read_bytes()
        os.utime(path)
    except OSError:
        return None
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        return None
    _load_lapack()
    payload, inputs, outputs, result = pickle.loads(content[32:])
    in_tree = jax.tree.structure(((0,) * inputs, {}))
    try:
        run = serialize_executable.deserialize_and_load(payload, in_tree, jax.tree.structure([0] * outputs))
    except jax.errors.JaxRuntimeError:
        return None
    return _Program(run, result)


@functools.cache
def _load_lapack() -> None:
    """Lowering a factorization hands LAPACK's addresses to XLA; an executable without them would crash."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


def _write(path: Path, content: bytes) -> None:
    """All or nothing, and nothing where the folder cannot be written to."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as draft:
            draft.write(content)
        os.replace(draft.name, path)
        _trim(path.parent)
    except OSError:
        return


def _trim(folder: Path) -> None:
    """Remove the programs unused for longest until the folder is below its limit."""
    files = sorted((x.stat().st_mtime, x.stat().st_size, x) for x in folder.iterdir())
    excess = sum(size for _, size, _ in files) - MOST_BYTES
    for _, size, file in files:
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size
