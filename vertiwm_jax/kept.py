"""Compiled programs of earlier processes, found without being traced.

JAX's cache of compiled programs asks for a program that is traced and lowered, to know which one it
is. Here a program is known by all that decides it, which takes milliseconds.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import inspect
import os
import pickle
import platform
import types
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import Mesh

from vertiwm_jax import atomic, xla

T = TypeVar("T")

_PACKAGE = Path(__file__).parent
_DEPENDENCIES = "chex", "flax", "gymnax", "jax", "jaxlib", "jaxlie", "numpy", "optax"
_KNOWN = {_PACKAGE.name, "builtins", "functools", *_DEPENDENCIES}
"""Where all that decides a program may come from: this source, and packages of known versions."""
_PROGRAMS = 64
"""How many are kept, of up to 10 MB each; of more, those used longest ago go."""
_held: dict[Any, jax.stages.Compiled] = {}
"""Programs of `jit` in this process."""


class _CannotTell(Exception):
    """What decides a program is something that another process could not recognize."""


def program(
    decided_by: Any, mesh: Mesh, compiles: Callable[[], jax.stages.Compiled]
) -> jax.stages.Compiled:
    """A program as an earlier process has kept it, or else compiled now, and kept.

    Programs lie beside those of JAX's cache, and where that is off nothing is kept. A file that
    cannot be read, or not be written, only means that the program is compiled.

    Args:
        decided_by: what decides the program: settings, shapes, functions of this package.
        mesh: of the devices of the program, which decide it, too.
        compiles: makes it.
    """
    file = _file(decided_by, mesh)
    if file is None:
        return compiles()
    with contextlib.suppress(Exception):
        return _load(file, mesh)
    with _apart_from_cache():
        made = compiles()
    with contextlib.suppress(Exception):
        _keep(file, made)
    return made


def jit(
    function: Callable[..., T],
    *,
    static_argnames: str | tuple[str, ...] = (),
    brief: bool = True,
    compiler_options: Mapping[str, int] = types.MappingProxyType({}),
) -> Callable[..., T]:
    """`jax.jit` for a program of the start of a training, which later processes need not trace.

    Only if `xla.keep_compiled` was called: what was changed in this process, as tests do, would
    not be seen.

    brief: whether it runs only briefly, and is therefore compiled in about half the time; loops
        that use vector units run many times slower in it. compiler_options: are added.
    """
    names = (static_argnames,) if isinstance(static_argnames, str) else static_argnames
    signature = inspect.signature(function)

    @functools.cache  # To ask for options starts JAX, which is too early where this is imported.
    def jitted() -> Any:
        options = {**(xla.brief_options() if brief else {}), **compiler_options}
        return jax.jit(function, static_argnames=names, compiler_options=options)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> T:
        given = signature.bind(*args, **kwargs)
        given.apply_defaults()
        static = {name: given.arguments[name] for name in names}
        varied = {name: x for name, x in given.arguments.items() if name not in static}
        leaves, kind = jax.tree.flatten(varied)
        mesh = _mesh(leaves) if xla.keeps_compiled() else None
        if mesh is None:
            return jitted()(**given.arguments)
        kinds = tuple(map(_kind, leaves))
        key = function, tuple(static.values()), kind, kinds, mesh
        if key not in _held:
            decided_by = function, static, brief, dict(compiler_options), str(kind), kinds
            lowered = functools.partial(jitted().lower, **given.arguments)
            _held[key] = program(decided_by, mesh, lambda: lowered().compile())
        return _held[key](**varied)

    return call


def _mesh(leaves: list[Any]) -> Mesh | None:
    """The devices of a program with such arguments, or None where no mesh has those of all."""
    mesh = jax.sharding.get_mesh()
    if not mesh.empty:
        return mesh
    arrays = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    devices = {device for array in arrays for device in array.devices()} or set(jax.devices()[:1])
    return Mesh(np.array([*devices]), ("one",)) if len(devices) == 1 else None


def _kind(leaf: Any) -> tuple[Any, ...]:
    """All of an argument that decides a program."""
    of = jax.typeof(leaf)
    return of.shape, str(of.dtype), of.weak_type, str(getattr(leaf, "sharding", None))


def forget() -> None:
    """Gives back the memory of the programs of `jit`."""
    _held.clear()


def identity(x: Any) -> Any:
    """What two things have in common that decide the same programs: strings in tuples.

    Raises `_CannotTell` where that is not known, as of a function that closes over something, or
    that is of another package.
    """
    kind = _name(type(x))
    if x is None or isinstance(x, bool | int | float | str | bytes | Enum | np.dtype):
        return kind, repr(x)
    if isinstance(x, tuple | list):
        return kind, *map(identity, x)
    if isinstance(x, dict):
        return kind, *((identity(key), identity(value)) for key, value in x.items())
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        values = np.ascontiguousarray(x)
        return kind, str(values.dtype), str(np.shape(x)), hashlib.sha256(values).hexdigest()
    if isinstance(x, functools.partial):
        return kind, identity(x.func), identity(x.args), identity(x.keywords)
    if isinstance(x, types.FunctionType) and x.__closure__:
        raise _CannotTell(x.__qualname__)
    if isinstance(x, type | types.FunctionType):
        return kind, _name(x)
    if dataclasses.is_dataclass(x):
        fields = ((field.name, getattr(x, field.name)) for field in dataclasses.fields(x))
        return kind, *((name, identity(value)) for name, value in fields)
    raise _CannotTell(kind)


def _name(x: Any) -> str:
    """Module and name of a class or function."""
    name = f"{x.__module__}.{x.__qualname__}"
    if x.__module__.split(".")[0] not in _KNOWN or "<" in name:
        raise _CannotTell(name)
    return name


def _file(decided_by: Any, mesh: Mesh) -> Path | None:
    """Where the program lies if it is kept; None if it is not to be."""
    config = jax.config.values
    folder = config["jax_compilation_cache_dir"]
    if not folder or not config["jax_enable_compilation_cache"] or jax.process_count() > 1:
        return None
    # Of JAX all but where and how it keeps things itself.
    settings = sorted((name, repr(x)) for name, x in config.items() if "cache" not in name)
    first = mesh.devices.flat[0]
    machine = xla.cpu(), first.device_kind, first.client.platform, first.client.platform_version
    devices = repr(mesh), [device.id for device in mesh.devices.flat]
    asked = platform.python_version(), os.environ.get("XLA_FLAGS")
    try:
        told = identity(decided_by), devices, settings, _source(), machine, asked
    except _CannotTell:
        return None
    return Path(folder) / "ready" / hashlib.sha256(repr(told).encode()).hexdigest()


@functools.cache
def _source() -> tuple[str, ...]:
    """Of this package and what it needs."""
    versions = (f"{name} {importlib.metadata.version(name)}" for name in _DEPENDENCIES)
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest(), *versions


@contextlib.contextmanager
def _apart_from_cache() -> Iterator[None]:
    """Nothing is read from JAX's cache: what comes from there lacks functions if it is kept."""
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
        compilation_cache.reset_cache()


@functools.cache
def _initialize_lapack() -> None:
    """As lowering does; a program that calls it would end a process that has lowered nothing."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


def _load(file: Path, mesh: Mesh) -> jax.stages.Compiled:
    _initialize_lapack()
    devices = mesh.devices.flatten().tolist()
    parts = pickle.loads(file.read_bytes())
    found = serialize_executable.deserialize_and_load(
        *parts, backend=devices[0].client, execution_devices=devices
    )
    os.utime(file)
    return found


def _keep(file: Path, made: jax.stages.Compiled) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic.write(file, pickle.dumps(serialize_executable.serialize(made)))
    newest = sorted(file.parent.iterdir(), key=lambda path: path.stat().st_mtime)
    for old in newest[:-_PROGRAMS]:
        old.unlink(missing_ok=True)
