"""Batches shared out to several devices: accelerators, or the cores of a CPU.

A mesh in context (`jax.set_mesh(devices.mesh(...))`) says to which. Without one, and inside of what
is shared out already, everything is computed in one place.
"""

import contextlib
import ctypes
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from vertiwm_jax import hosts, xla

T = TypeVar("T")

AXIS = "devices"
"""The axis of the mesh."""
FEWEST = 4
"""Rows of a batch that are worth a device of their own."""
_PATIENCE = 7 * 24 * 3600  # seconds
_WORTH_ROUNDING = 0.75  # of the time; 0.55 was measured with AVX512_BF16, above 1.5 without


def cores() -> int:
    """Cores that this process may use."""
    # Affinity is Linux only; elsewhere every core may be used.
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def use_cores() -> None:
    """Makes every core of a CPU a device, unless `JAX_NUM_CPU_DEVICES` sets their number.

    Two devices of one core each are faster than one of two cores, whose cores wait for each other
    after every operation (docs/scaling.md). `RuntimeError` where JAX has started already with
    another number of them.
    """
    # Where another program takes one core, the others wait; after 60 s XLA would end the process.
    limits = ("warn_stuck", "terminate")
    xla.add_flags(
        {f"xla_cpu_collective_call_{limit}_timeout_seconds": _PATIENCE for limit in limits}
    )
    if "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    try:
        jax.config.update("jax_num_cpu_devices", cores())
    except RuntimeError as error:
        if (found := jax.local_device_count("cpu")) == cores():
            return
        raise RuntimeError(
            f"use_cores: JAX has started with {found} CPU device(s) of {cores()}. Call it before "
            "whatever starts JAX, as to import gymnax or an environment of this package does, or "
            f"set JAX_NUM_CPU_DEVICES={cores()}"
        ) from error


@cache
def multiplies_bfloat16() -> bool:
    """Whether this is a CPU that multiplies matrices of bfloat16 clearly faster than of float32.

    It is tried, which takes half a second. Of several hosts, which all have to ask, it is
    what the first one finds.
    """
    if jax.default_backend() != "cpu":
        return False
    single, half = _seconds_of_matmul(jnp.float32, jnp.bfloat16)
    return bool(hosts.of_first(np.array(half < _WORTH_ROUNDING * single)))


def mesh(batch: int) -> Mesh:
    """The devices for batches of this size: as many as divide it and have `FEWEST` rows or more.

    They are equally many of each host; where that cannot be, every host does all with its own.
    """
    most, each = max(1, batch // FEWEST), jax.local_device_count()
    of_all = sorted(jax.devices(), key=lambda device: device.process_index)
    together, alone = np.reshape(of_all, (-1, each)), np.reshape(jax.local_devices(), (1, each))
    even = next(
        by_host[:, :number]
        for by_host in (together, alone)
        for number in range(each, 0, -1)
        if len(by_host) * number <= most and batch % (len(by_host) * number) == 0
    )
    return Mesh(even.ravel(), (AXIS,), axis_types=(AxisType.Auto,))


def everywhere(mesh: Mesh, tree: T) -> T:
    """A pytree of arrays, of which every device has a copy; of several hosts, the first one's."""
    places = on_all(mesh)
    if not mesh.is_multi_process:
        if mesh.devices.flat[0].platform == "cpu":
            # All cores read one copy: JAX takes arrays of NumPy as they lie in memory.
            tree = hosts.with_keys(tree, jax.tree.map(np.asarray, hosts.without_keys(tree)))
        return jax.device_put(tree, places)
    sent = hosts.of_first(hosts.without_keys(tree))
    placed = jax.tree.map(partial(jax.make_array_from_process_local_data, places), sent)
    return hosts.with_keys(tree, placed)


def on_all(mesh: Mesh) -> NamedSharding:
    """The place of what every device has a copy of."""
    return NamedSharding(mesh, PartitionSpec())


def in_one_place(tree: T) -> T:
    """This host's first copies of arrays that every device has; their types know of no mesh."""
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def shared_out(function: Callable[..., T], batch: int) -> Callable[..., T]:
    """A compiled function that spreads batches of this size; its results are on one device."""

    def on_mesh(*args: Any) -> T:
        over = mesh(batch)
        with jax.set_mesh(over):
            result = function(*everywhere(over, args))
        release_memory()
        if over.is_multi_process:
            return in_one_place(jax.device_put(result, on_all(over)))
        return in_one_place(everywhere(over, result))

    return on_mesh


def shapes(function: Callable[..., T], batch: int) -> Callable[..., T]:
    """What `shared_out` of a function gives, of which only shapes are known; it is traced here."""

    def on_mesh(*args: Any) -> T:
        over = mesh(batch)
        with jax.set_mesh(over):
            return jax.eval_shape(function, *everywhere(over, args))

    return on_mesh


def in_turns(function: Callable[[Any], T], batch: Any, at_a_time: int) -> T:
    """What a function gives for all rows of leaves `[B, ...]`, of so many of which it is asked.

    All results are in memory once, and those of one turn again.
    """
    size = len(jax.tree.leaves(batch)[0])
    found = None
    for first in range(0, size, at_a_time):
        first = min(first, size - at_a_time)  # The last turn has some rows of the one before.
        rows = slice(first, first + at_a_time)
        given = function(jax.tree.map(lambda x, rows=rows: x[rows], batch))
        if found is None:
            found = _room(given, size)
        found = _with_rows(found, given, first)
    return cast(T, found)


@partial(jax.jit, static_argnames="size")
def _room(tree: T, size: int) -> T:
    """Zeros `[size, ...]` for leaves `[..., ...]`."""
    return jax.tree.map(lambda x: jnp.zeros((size, *x.shape[1:]), x.dtype), tree)


@partial(jax.jit, donate_argnums=0)
def _with_rows(tree: T, some: T, first: jax.Array) -> T:
    """The tree with some of its rows, `first` and those that follow it, replaced."""
    return jax.tree.map(
        lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, first, axis=0), tree, some
    )


def release_memory() -> None:
    """Gives back to the system what compilers have freed, which glibc keeps for later."""
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # Other C libraries have no such function.
            ctypes.CDLL(None).malloc_trim(0)


def forget_programs() -> None:
    """Gives back the memory of all that was compiled, before what will not call it again.

    What is held as compiled, as by `training.compiled`, stays.
    """
    jax.clear_caches()
    release_memory()


def spread(
    function: Callable[..., Any], in_axes: Sequence[int | None], at_a_time: int | None = None
) -> Callable[..., Any]:
    """`jax.vmap` of a function, the batch shared out to the devices.

    in_axes: 0 for arguments with the axis of the batch, None for others. All arrays must be
        arguments: what a function closes over is not on the device.
    at_a_time: how many of the batch a device computes together at most; all its share by default.
        A batch that does not come out even is filled up with some of its rows again.
    """

    def of_batch(*args: Any) -> Any:
        mapped = [arg for arg, axis in zip(args, in_axes, strict=True) if axis == 0]
        size, shares = len(jax.tree.leaves(mapped)[0]), number()
        of_each = -(-size // shares)
        turns = -(-of_each // (at_a_time or of_each))
        together = -(-of_each // turns)
        rows = np.arange(shares * turns * together) % size

        def of_device(*args: Any) -> Any:
            if turns == 1:
                return jax.vmap(function, in_axes)(*args)
            mapped = [arg for arg, axis in zip(args, in_axes, strict=True) if axis == 0]

            def of_one(row: list[Any]) -> Any:
                own, all_ = iter(row), zip(args, in_axes, strict=True)
                return function(*(next(own) if axis == 0 else arg for arg, axis in all_))

            return jax.lax.map(of_one, mapped, batch_size=together)

        of_all = split(of_device, in_axes)
        if len(rows) == size:
            return of_all(*args)
        filled = [
            arg if axis is None else jax.tree.map(lambda x: x[rows], arg)
            for arg, axis in zip(args, in_axes, strict=True)
        ]
        return jax.tree.map(lambda x: x[:size], of_all(*filled))

    return of_batch


def split(function: Callable[..., Any], in_axes: Sequence[int | None]) -> Callable[..., Any]:
    """A function of batches, which each device calls with its share of the rows; they divide it.

    in_axes: as for `spread`.
    """
    shares = number()
    if shares == 1:
        return function
    places = tuple(PartitionSpec(AXIS) if axis == 0 else PartitionSpec() for axis in in_axes)

    def of_batch(*args: Any) -> Any:
        # Arrays without elements are made where they are used: as operands of `shard_map` they end
        # jaxlib 0.11 in a segmentation fault (Shardy's ManualComputationUnusedInputsPattern).
        filled = jax.tree.map(lambda x: x if np.size(x) else None, args)

        def of_share(*given: Any) -> Any:
            rows = [shares if axis == 0 else 1 for axis in in_axes]
            return function(*map(_with_empty, given, args, rows))

        return jax.shard_map(
            of_share, in_specs=places, out_specs=PartitionSpec(AXIS), check_vma=False
        )(*filled)

    return of_batch


def _with_empty(given: T, whole: T, shares: int) -> T:
    """Leaves `[B / shares, ...]`, with those that `whole`, `[B, ...]`, has without elements."""

    def leaf(given: Any, whole: Any) -> Any:
        if given is not None or whole is None:
            return given
        return jnp.zeros((len(whole) // shares, *whole.shape[1:]), whole.dtype)

    return jax.tree.map(leaf, given, whole, is_leaf=lambda x: x is None)


def share(tree: T) -> T:
    """A pytree with leaves `[B, ...]`, each device with a share of the rows; it divides B."""
    return _placed(tree, PartitionSpec(AXIS))


def whole(tree: T) -> T:
    """A pytree of which every device has all."""
    return _placed(tree, PartitionSpec())


def number() -> int:
    """Devices to share out to, here."""
    around = jax.sharding.get_abstract_mesh()
    return around.shape[AXIS] if AXIS in around.auto_axes else 1


def _placed(tree: T, places: PartitionSpec) -> T:
    return jax.lax.with_sharding_constraint(tree, places) if number() > 1 else tree


def _seconds_of_matmul(*dtypes: Any) -> list[float]:
    """The shortest of many products of matrices of each type, in turns: others may be busy here."""
    matmul = jax.jit(partial(jnp.matmul, preferred_element_type=jnp.float32))
    operands = [(jnp.ones((256, 512), kind), jnp.ones((512, 512), kind)) for kind in dtypes]
    seconds = []
    for _ in range(200):  # The first of which compiles.
        for pair in operands:
            start = time.perf_counter()
            matmul(*pair).block_until_ready()
            seconds.append(time.perf_counter() - start)
    return np.reshape(seconds, (-1, len(dtypes))).min(axis=0).tolist()
