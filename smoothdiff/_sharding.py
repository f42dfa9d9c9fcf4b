"""The samples of one estimate over the devices of a mesh."""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree


def as_sharding(given: Any) -> NamedSharding | None:
    """Along which axis of which mesh samples lie.

    Raises:
        TypeError, ValueError: it is neither a mesh of one axis, nor a NamedSharding with one entry.
    """
    if given is None:
        return None
    if isinstance(given, Mesh):
        if len(given.axis_names) != 1:
            raise ValueError(
                f"sharding: the mesh has the axes {given.axis_names}; say along which the samples "
                f"lie, NamedSharding(mesh, PartitionSpec({given.axis_names[0]!r}))"
            )
        given = NamedSharding(given, PartitionSpec(given.axis_names[0]))
    if not isinstance(given, NamedSharding):
        raise TypeError(
            "sharding must be a mesh of devices, such as jax.make_mesh((jax.device_count(),), "
            f'("samples",)), or a NamedSharding of one, not {given!r}'
        )
    if len(given.spec) != 1 or given.spec[0] is None:
        raise ValueError(
            f"sharding: samples have one axis, and {given.spec} says where {len(given.spec)} lie: "
            "write PartitionSpec(name) with the name of an axis of the mesh"
        )
    # axes of jax.make_mesh are explicit: JAX would ask for the sharding of each array on the way
    return NamedSharding(Mesh(np.asarray(given.mesh.devices), given.mesh.axis_names), given.spec)


def parts(sharding: NamedSharding) -> int:
    """Over how many devices the samples are shared out."""
    (names,) = sharding.spec
    chosen = names if isinstance(names, tuple) else (names,)
    size = 1
    for name in chosen:
        size *= sharding.mesh.shape[name]
    return size


def check_parts(sharding: NamedSharding, samples: int, what: str) -> None:
    """Raises ValueError where the devices would not have the same number of samples."""
    count = parts(sharding)
    if samples % count:
        raise ValueError(
            f"{what} is {samples}, which {count} devices cannot share equally: make it a multiple "
            f"of {count}, such as {-(-samples // count) * count}"
        )


def columns_shared_out(rows: jax.Array, sharding: NamedSharding) -> jax.Array:
    """Rows of which each device has some columns, if they can be shared equally."""
    if rows.shape[1] % parts(sharding):
        return rows
    columns = NamedSharding(sharding.mesh, PartitionSpec(None, *sharding.spec))
    return jax.lax.with_sharding_constraint(rows, columns)


def shared_out(rows: PyTree, sharding: NamedSharding | None) -> PyTree:
    """Rows, each where its sample is; without a sharding as they are."""
    if sharding is None:
        return rows
    return jax.tree.map(lambda a: jax.lax.with_sharding_constraint(a, sharding), rows)
