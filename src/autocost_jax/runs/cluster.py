"""Several processes, on one machine or many, as one run.

Every process runs the same program and holds its share of the slots; JAX's own runtime
connects them. What is small (candidates, the strategy's state) all of them compute
alike; only the first process prints and writes.
"""

import os
import sys
from typing import Any

import jax
import numpy as np

from autocost_jax.files import flatten, stored_like, unflatten

AUTO = "auto"


def join(
    coordinator: str | None, num_processes: int | None, process_id: int | None
) -> None:
    """Connect this process to the others; nothing happens without a coordinator.

    Must be called before anything of JAX has run.

    Args:
      coordinator: HOST:PORT of the first process, the same in all of them; "auto" asks
        SLURM, Open MPI or Kubernetes.
      num_processes: of the run; None with "auto".
      process_id: of this process, from 0; None with "auto".

    Raises:
      ValueError: for an incomplete or contradictory description.
    """
    if coordinator is None:
        if (num_processes, process_id) != (None, None):
            raise ValueError("num_processes and process_id need a coordinator")
        return
    known = _description(coordinator, num_processes, process_id)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(**known)
    wait_for_all()  # on CPUs connections are made within 30 s of each other, or never


def _description(
    coordinator: str, num_processes: int | None, process_id: int | None
) -> dict[str, Any]:
    """What JAX is told of the processes; nothing where it is to ask the cluster."""
    if coordinator == AUTO:
        if (num_processes, process_id) != (None, None):
            raise ValueError("with coordinator=auto leave out the other two")
        return {}
    if num_processes is None or process_id is None:
        raise ValueError(
            "a coordinator needs num_processes and process_id, "
            f"got {num_processes} and {process_id}"
        )
    if not 0 <= process_id < num_processes:
        raise ValueError(
            f"process_id must be in [0, {num_processes}), got {process_id}"
        )
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"coordinator must be auto or HOST:PORT, got {coordinator}")
    return {
        "coordinator_address": coordinator,
        "num_processes": num_processes,
        "process_id": process_id,
    }


def is_first() -> bool:
    """Whether this process is the one that prints and writes."""
    return jax.process_index() == 0


def share(tree: Any, template: Any) -> Any:
    """The first process's tree, in every process.

    Args:
      tree: in the first process a pytree of arrays or None, elsewhere ignored.
      template: a pytree of the same structure, shapes and dtypes.

    Returns:
      The tree, or None if it is None in the first process.
    """
    if jax.process_count() == 1:
        return tree
    from jax.experimental import multihost_utils

    is_there = multihost_utils.broadcast_one_to_all(np.asarray(tree is not None))
    if not bool(is_there):
        return None
    if tree is None:  # the values do not matter, and those of others cannot be read
        like = stored_like(template)
        arrays = {name: np.zeros(x.shape, x.dtype) for name, x in like.items()}
    else:
        arrays = flatten(tree)
    arrays = multihost_utils.broadcast_one_to_all(arrays)
    return unflatten(jax.tree.map(np.asarray, arrays), template)


def wait_for_all() -> None:
    """Return when every process has come here."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices("autocost_jax")


def is_lost_peer(error: Exception) -> bool:
    """Whether an error says that another process is gone.

    JAX raises it as a RuntimeError or a ValueError, by where it notices.
    """
    return "Gloo" in str(error)


def leave(status: int) -> None:
    """End a process of several at once, without waiting for the others.

    JAX would wait for processes that may be gone. They notice at their next exchange.
    """
    if jax.distributed.is_initialized() and jax.process_count() > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
