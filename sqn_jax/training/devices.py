"""One run on several devices: seeds are spread first, then the robots of each.

Devices with seeds of their own have nothing to wait for. Those that share seeds divide robots,
minibatches and the replay's episodes evenly; each has all parameters of its seeds, and gradients
are averaged. What a robot does and which episodes are drawn does not depend on the number of
devices: a seed gives the same run, to the rounding of sums. It does not matter either which process
the devices belong to (`processes.py`).

The cores of a CPU count as devices of their own (`use_cores`). One XLA program on two cores splits
every small loop between them and waits for both; two programs side by side wait for each other once
an update.
"""

from __future__ import annotations

import math
import os
import platform
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sqn_jax.agent.shards import AXIS, SEEDS
from sqn_jax.config import TrainConfig
from sqn_jax.outside.messages import say

REPLICATED = PartitionSpec()
"""Each device gets all of an array."""

SMALLEST_SHARD = 8
"""Robots of a minibatch below which another device is not worth it."""


def use_cores() -> None:
    """Let every core of the CPU be a device; without effect once JAX has started its devices.

    A number that the user has set (`JAX_NUM_CPU_DEVICES`, `XLA_FLAGS`) is left as it is.
    """
    is_set = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if is_set or jax.config.jax_num_cpu_devices > 0:  # type: ignore[attr-defined]
        return
    try:
        jax.config.update("jax_num_cpu_devices", num_cores())
    except RuntimeError:  # The devices are there already.
        return


def require(kind: str | None) -> None:
    """Choose the kind of device before JAX starts its devices, and see that there is one.

    Args:
        kind: "cpu", "gpu" or "tpu"; None takes an accelerator if there is one, else the CPU.

    Raises:
        ValueError: there is none of this kind, or none that JAX may use.
    """
    _use_own_modes()
    if kind == "cpu":
        jax.config.update("jax_platforms", "cpu")
    try:
        backend = jax.devices()[0].platform
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        if not isinstance(error, RuntimeError):  # An assertion of JAX says nothing.
            reason = f"JAX_PLATFORMS is {os.environ.get('JAX_PLATFORMS', '')!r}"
        raise ValueError(f"JAX finds no device as it is set up here ({reason})") from None
    if kind is not None and backend != kind:
        raise ValueError(f"--device is {kind}, expected one that JAX finds here: {backend}")
    if kind is None and backend == "cpu" and not os.environ.get("JAX_PLATFORMS") and _has_nvidia():
        say(
            "there is an NVIDIA GPU, but this JAX cannot use it: running on the CPU "
            "(pip install 'jax[cuda12]')",
            error=True,
        )


_MODES = {
    "jax_enable_x64": False,
    "jax_numpy_dtype_promotion": "standard",
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_disable_jit": False,
}
"""What all programs here expect: single precision, NaN for what is not known yet, compilation."""


def _use_own_modes() -> None:
    """Say and change what the environment has set for the programs of others."""
    for name, expected in _MODES.items():
        if (value := getattr(jax.config, name)) != expected:
            jax.config.update(name, expected)
            say(f"{name.upper()} is {value}, used is {expected}", error=True)


def _has_nvidia() -> bool:
    return Path("/dev/nvidia0").exists()


def describe(mesh: Mesh | None = None) -> str:
    """What computes: the kind of device, and how many of them."""
    device = jax.devices()[0]
    kind = cpu_model() if device.platform == "cpu" else device.device_kind
    times = "" if mesh is None else f" x {mesh.size}"
    if mesh is not None and (count := jax.process_count()) > 1:
        times += f" in {count} processes"
    return f"{device.platform} ({kind}){times}"


def cpu_model() -> str:
    """The processor by name, as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def num_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe_division(mesh: Mesh | None, num_seeds: int) -> str:
    """How a run with several seeds is divided between devices; "" for one of either."""
    if mesh is None or num_seeds == 1:
        return ""
    groups, shards = mesh.shape[SEEDS], mesh.shape[AXIS]
    seeds = f"{num_seeds} seeds spread over {groups}" if groups > 1 else f"all {num_seeds} seeds"
    robots = f"robots of each over {shards}" if shards > 1 else "all robots of a seed on one"
    return f" ({seeds}, {robots})"


def choose(config: TrainConfig, wanted: int | None = None) -> Mesh | None:
    """The devices for a run, as many of each process; None stands for one alone.

    Args:
        config: the run.
        wanted: how many. By default as many cores of a CPU as leave each at least
            `SMALLEST_SHARD` robots of a minibatch, or has a seed of its own; and one accelerator,
            or all of several processes.

    Raises:
        ValueError: there are not as many, or the robots cannot be divided evenly.
    """
    most, processes = len(jax.devices()), jax.process_count()
    if wanted is None:
        count = most
        if jax.devices()[0].platform == "cpu":
            worth = [n for n in range(processes, most + 1, processes) if _is_worth(n, config)]
            count = max(worth, default=processes)
        elif processes == 1:
            count = 1
    else:
        count = wanted
    places = f"{processes} processes, as many of each" if processes > 1 else "this machine"
    _require(
        processes <= count <= most and count % processes == 0,
        count,
        f"{processes} to {most} of {places}",
    )
    sizes = f"num_envs ({config.num_envs}) and learner.batch_size ({config.learner.batch_size})"
    several = f" times one of num_seeds ({config.num_seeds})" if config.num_seeds > 1 else ""
    _require(_divides(count, config), count, f"a divisor of {sizes}{several}")
    return first_devices(count, math.gcd(count, config.num_seeds))


def first_devices(count: int, groups: int = 1) -> Mesh | None:
    """The first devices of each process, `count` in all; None stands for one alone.

    Args:
        count: at most as many as there are, a multiple of the number of processes.
        groups: into how many they are divided that have seeds of their own.
    """
    if count == 1:
        return None
    of_each = count // jax.process_count()
    chosen = [
        device
        for process in range(jax.process_count())
        for device in jax.local_devices(process)[:of_each]
    ]
    # Not `jax.make_mesh`, which may order them otherwise: a group should lie in one process.
    places = np.array(chosen).reshape(groups, count // groups)
    return Mesh(places, (SEEDS, AXIS), axis_types=(AxisType.Auto, AxisType.Auto))


def one_and_all() -> list[Mesh | None]:
    """One device alone and, where there are several, all of them: what a benchmark compares."""
    return [first_devices(count) for count in sorted({1, len(jax.devices())})]


def _divides(count: int, config: TrainConfig) -> bool:
    shards = count // math.gcd(count, config.num_seeds)
    return config.num_envs % shards == 0 and config.learner.batch_size % shards == 0


def _is_worth(count: int, config: TrainConfig) -> bool:
    shards = count // math.gcd(count, config.num_seeds)
    is_large = config.learner.batch_size // shards >= SMALLEST_SHARD
    return _divides(count, config) and (shards == 1 or is_large)


def _require(condition: bool, value: int, expected: str) -> None:
    if not condition:
        raise ValueError(f"--num-devices is {value}, expected {expected}")


def place(tree: Any, mesh: Mesh | None, specs: Any = REPLICATED) -> Any:
    """Arrays on the devices of a mesh.

    Args:
        tree: arrays, the same in all processes.
        mesh: None leaves them where they are.
        specs: how they are divided, a tree or the beginning of one.
    """
    if mesh is None:
        return tree
    return jax.tree.map(put, tree, jax.tree.broadcast(_shardings(mesh, specs), tree))


def put(array: Any, sharding: Any) -> jax.Array:
    """An array that every process has, where a sharding wants it; each makes its own part."""
    if sharding.is_fully_addressable:
        return jax.device_put(array, sharding)
    return jax.make_array_from_callback(array.shape, sharding, lambda part: array[part])


def own_part(array: Any) -> Any:
    """What one device of this process has of an array, on the host."""
    return np.asarray(array.addressable_data(0) if isinstance(array, jax.Array) else array)


def on_host(tree: Any) -> Any:
    """Arrays as NumPy has them, whole in every process; all processes are to call it."""
    return jax.tree.map(_whole, tree)


def _whole(array: Any) -> Any:
    if not isinstance(array, jax.Array) or array.is_fully_addressable or array.is_fully_replicated:
        return np.asarray(array)
    return multihost_utils.process_allgather(array, tiled=True)


def placed_shapes(shapes: Any, mesh: Mesh | None, specs: Any = REPLICATED) -> Any:
    """Shapes of the arrays that `place` would return for arrays of these shapes."""
    if mesh is None:
        return shapes
    return jax.tree.map(
        lambda x, sharding: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding),
        shapes,
        jax.tree.broadcast(_shardings(mesh, specs), shapes),
    )


def _shardings(mesh: Mesh, specs: Any) -> Any:
    return jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        specs,
        is_leaf=lambda x: isinstance(x, PartitionSpec),
    )
