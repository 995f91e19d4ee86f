"""Batches shared out to several devices: accelerators, or the cores of a CPU.

A mesh in context (`jax.set_mesh(parallel.mesh(...))`) says to which. Without one, and inside of
what is shared out already, everything is computed in one place.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from vertiwm_jax import hosts, machine

T = TypeVar("T")

SEEDS, BATCH = "seeds", "batch"
"""The axes of a mesh: along one devices have seeds of their own, along the other they share."""
WHOLE, ROWS = PartitionSpec(), PartitionSpec(BATCH)
"""Of arrays that every device has whole, and of those whose rows devices share."""
FEWEST = 4
"""Rows of a batch that are worth a device of their own."""


def mesh(batch: int, seeds: int = 1) -> Mesh:
    """The devices for batches of this size: as many as divide it and have `FEWEST` rows or more.

    They are equally many of each host; where that cannot be, every host does all with its own.
    Where all devices can have as many seeds, each has some with all rows of their batches.
    """
    each = jax.local_device_count()
    of_all = sorted(jax.devices(), key=lambda device: device.process_index)
    if seeds > 1 and seeds % len(of_all) == 0:
        return _mesh(np.reshape(of_all, (-1, 1)))
    most = max(1, batch // FEWEST)
    together, alone = np.reshape(of_all, (-1, each)), np.reshape(jax.local_devices(), (1, each))
    even = next(
        by_host[:, :number]
        for by_host in (together, alone)
        for number in range(each, 0, -1)
        if len(by_host) * number <= most and batch % (len(by_host) * number) == 0
    )
    return _mesh(np.reshape(even, (1, -1)))


def number() -> int:
    """Devices to share batches out to, here."""
    around = jax.sharding.get_abstract_mesh()
    return around.shape[BATCH] if BATCH in around.auto_axes else 1


def sharing() -> int:
    """Devices that share this batch; for use inside of `shard`, and 1 elsewhere."""
    around = jax.sharding.get_abstract_mesh()
    return around.shape[BATCH] if BATCH in around.manual_axes else 1


def total(tree: T) -> T:
    """Sum over the devices that share a batch."""
    return jax.lax.psum(tree, BATCH) if sharing() > 1 else tree


def mean(tree: T) -> T:
    """Mean over the devices that share a batch."""
    if sharing() == 1:
        return tree
    # JAX computes gradients of weights as transposes of products. They are sent as the products
    # are, or XLA would compute the transposes themselves, which takes a CPU longer: 15 % of an
    # update on the paper's schedule.
    turned = jax.lax.pmean(jax.tree.map(jnp.transpose, tree), BATCH)
    return jax.tree.map(jnp.transpose, turned)


def moments(x: jax.Array, axis: int | tuple[int, ...] | None = None) -> tuple[jax.Array, jax.Array]:
    """Mean and variance along axes, of all devices that share a batch."""
    middle = mean(jnp.mean(x, axis, keepdims=True))
    variance = mean(jnp.mean((x - middle) ** 2, axis))
    return middle.reshape(variance.shape), variance


def place(mesh: Mesh, tree: T, specs: Any = WHOLE) -> T:
    """A pytree of arrays on the devices; of several hosts, the first one's.

    specs: how leaves are shared out, or a tree of that; every device has a copy by default.
    """
    if not mesh.is_multi_process:
        if mesh.devices.flat[0].platform == "cpu":
            # All cores read one copy: JAX takes arrays of NumPy as they lie in memory.
            tree = hosts.with_keys(tree, jax.tree.map(np.asarray, hosts.without_keys(tree)))
        return jax.device_put(tree, shardings(mesh, specs))

    def put(place: NamedSharding, leaf: np.ndarray) -> jax.Array:
        return jax.make_array_from_callback(leaf.shape, place, lambda index: leaf[index])

    sent = hosts.of_first(hosts.without_keys(tree))
    every = jax.tree.broadcast(shardings(mesh, specs), sent)
    return hosts.with_keys(tree, jax.tree.map(put, every, sent))


def shardings(mesh: Mesh, specs: Any = WHOLE) -> Any:
    """The places of leaves on a mesh."""
    return jax.tree.map(partial(NamedSharding, mesh), specs)


def with_axis(name: str, specs: Any) -> Any:
    """How leaves are shared out that have one more axis, the first, which devices share too."""
    return jax.tree.map(lambda spec: PartitionSpec(name, *spec), specs)


def gather(mesh: Mesh, tree: T) -> T:
    """Whole arrays on this host's first device; their types know of no mesh."""
    if mesh.is_multi_process:
        put = jax.jit(lambda leaves: leaves, out_shardings=shardings(mesh))(tree)
    else:
        put = place(mesh, tree)
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), put)


def shard(function: Callable[..., T], in_specs: Sequence[Any], out_specs: Any) -> Callable[..., T]:
    """`jax.shard_map` on the mesh in context; without one, the function as it is.

    in_specs: how the leaves of each argument are shared out, or trees of that. All arrays must be
        arguments: what a function closes over is not on the device.
    """
    mesh, in_specs = jax.sharding.get_abstract_mesh(), tuple(in_specs)
    if BATCH not in mesh.auto_axes or mesh.size == 1:
        return function

    def on_mesh(*args: Any) -> T:
        # Arrays without elements are made where they are used: as operands of `shard_map` they end
        # jaxlib 0.11 in a segmentation fault (Shardy's ManualComputationUnusedInputsPattern).
        filled = jax.tree.map(lambda x: x if np.size(x) else None, args)

        def on_device(*given: Any) -> T:
            def with_empty(spec: PartitionSpec, given: Any, whole: Any) -> Any:
                def leaf(given: Any, whole: Any) -> Any:
                    if given is not None or whole is None:
                        return given
                    shape = NamedSharding(mesh, spec).shard_shape(whole.shape)
                    return jnp.zeros(shape, whole.dtype)

                return jax.tree.map(leaf, given, whole, is_leaf=lambda x: x is None)

            return function(*jax.tree.map(with_empty, in_specs, given, args))

        spread = jax.shard_map(on_device, in_specs=in_specs, out_specs=out_specs, check_vma=False)
        return spread(*filled)

    return on_mesh


def vmap(
    function: Callable[..., Any], in_axes: Sequence[int | None], chunk: int | None = None
) -> Callable[..., Any]:
    """`jax.vmap` of a function, the batch shared out to the devices.

    in_axes: 0 for arguments with the axis of the batch, None for others. All arrays must be
        arguments: what a function closes over is not on the device.
    chunk: how many of the batch a device computes together at most; all its share by default.
        A batch that does not come out even is filled up with some of its rows again.
    """

    def of_batch(*args: Any) -> Any:
        mapped = [arg for arg, axis in zip(args, in_axes, strict=True) if axis == 0]
        size, shares = len(jax.tree.leaves(mapped)[0]), number()
        of_each = -(-size // shares)
        turns = -(-of_each // (chunk or of_each))
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

        of_all = shard(of_device, [ROWS if axis == 0 else WHOLE for axis in in_axes], ROWS)
        if len(rows) == size:
            return of_all(*args)
        filled = [
            arg if axis is None else jax.tree.map(lambda x: x[rows], arg)
            for arg, axis in zip(args, in_axes, strict=True)
        ]
        return jax.tree.map(lambda x: x[:size], of_all(*filled))

    return of_batch


def shared_out(function: Callable[..., T], batch: int) -> Callable[..., T]:
    """A compiled function that spreads batches of this size; its results are on one device."""

    def on_mesh(*args: Any) -> T:
        over = mesh(batch)
        with jax.set_mesh(over):
            result = function(*place(over, args))
        machine.release_memory()
        return gather(over, result)

    return on_mesh


def in_turns(function: Callable[[Any], T], batch: Any, at_a_time: int) -> T:
    """What a function gives for all rows of leaves `[B, ...]`, of so many of which it is asked.

    All results are in memory once, and those of one turn again.
    """
    size, found = len(jax.tree.leaves(batch)[0]), None
    for first in range(0, size, at_a_time):
        first = min(first, size - at_a_time)  # The last turn has some rows of the one before.
        rows = slice(first, first + at_a_time)
        given = function(jax.tree.map(lambda x, rows=rows: x[rows], batch))
        if found is None:
            found = jax.tree.map(lambda x: np.zeros((size, *x.shape[1:]), x.dtype), given)
        found = _with_rows(found, given, first)
    return cast(T, found)


@partial(jax.jit, donate_argnums=0)
def _with_rows(tree: T, some: T, first: jax.Array) -> T:
    """The tree with some of its rows, `first` and those that follow it, replaced."""
    return jax.tree.map(
        lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, first, axis=0), tree, some
    )


def placed(tree: T, spec: PartitionSpec) -> T:
    """A pytree, inside of a program, whose leaves all devices have whole or share out by rows."""
    return jax.lax.with_sharding_constraint(tree, spec) if number() > 1 else tree


def _mesh(devices: np.ndarray) -> Mesh:
    """Of devices `[seeds, batch]`."""
    return Mesh(devices, (SEEDS, BATCH), axis_types=(AxisType.Auto, AxisType.Auto))
