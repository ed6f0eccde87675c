"""One run on several devices: each steps its shard of the robots and learns from it.

Robots, minibatches and the replay's episodes are divided evenly; each device has all parameters,
and gradients are averaged. What a robot does and which episodes are drawn does not depend on the
number of devices: a seed gives the same run, to the rounding of sums.

The cores of a CPU count as devices of their own (`use_cores`). One XLA program on two cores splits
every small loop between them and waits for both; two programs side by side wait for each other once
an update.
"""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sqn_jax.agent.shards import AXIS
from sqn_jax.config import TrainConfig

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
    except Exception as error:  # JAX also fails by assertions, which say nothing.
        chosen = f"JAX_PLATFORMS is {os.environ.get('JAX_PLATFORMS', '')!r}"
        reason = " ".join(str(error).split())[:200] or chosen
        raise ValueError(f"JAX finds no device as it is set up here ({reason})") from None
    if kind is not None and backend != kind:
        raise ValueError(f"--device is {kind}, expected one that JAX finds here: {backend}")
    if kind is None and backend == "cpu" and not os.environ.get("JAX_PLATFORMS") and _has_nvidia():
        print(
            "there is an NVIDIA GPU, but this JAX cannot use it: running on the CPU "
            "(pip install 'jax[cuda12]')",
            file=sys.stderr,
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
            print(f"{name.upper()} is {value}, used is {expected}", file=sys.stderr)


def _has_nvidia() -> bool:
    return Path("/dev/nvidia0").exists()


def describe(mesh: Mesh | None = None) -> str:
    """What computes: the kind of device, and how many of them."""
    device = jax.devices()[0]
    kind = cpu_model() if device.platform == "cpu" else device.device_kind
    times = "" if mesh is None else f" x {mesh.size}"
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


def choose(config: TrainConfig, wanted: int | None = None) -> Mesh | None:
    """The devices for a run; None stands for one alone.

    Args:
        config: the run.
        wanted: how many. By default as many cores of a CPU as leave each at least
            `SMALLEST_SHARD` robots of a minibatch, and one accelerator.

    Raises:
        ValueError: there are not as many, or the robots cannot be divided evenly.
    """
    available = jax.devices()
    if wanted is None:
        most = len(available) if available[0].platform == "cpu" else 1
        worth = range(1, min(most, config.learner.batch_size // SMALLEST_SHARD) + 1)
        count = max((n for n in worth if _divides(n, config)), default=1)
    else:
        count = wanted
        _require(1 <= count <= len(available), count, f"1 to {len(available)} of this machine")
        sizes = f"num_envs ({config.num_envs}) and learner.batch_size ({config.learner.batch_size})"
        _require(_divides(count, config), count, f"a divisor of {sizes}")
    return first_devices(count)


def first_devices(count: int) -> Mesh | None:
    """The first devices that there are, at least `count`; None stands for one alone."""
    if count == 1:
        return None
    return jax.make_mesh((count,), (AXIS,), (AxisType.Auto,), devices=jax.devices()[:count])


def one_and_all() -> list[Mesh | None]:
    """One device alone and, where there are several, all of them: what a benchmark compares."""
    return [first_devices(count) for count in sorted({1, len(jax.devices())})]


def _divides(count: int, config: TrainConfig) -> bool:
    return config.num_envs % count == 0 and config.learner.batch_size % count == 0


def _require(condition: bool, value: int, expected: str) -> None:
    if not condition:
        raise ValueError(f"--num-devices is {value}, expected {expected}")


def place(tree: Any, mesh: Mesh | None, specs: Any = REPLICATED) -> Any:
    """Arrays on the devices of a mesh.

    Args:
        tree: arrays.
        mesh: None leaves them where they are.
        specs: how they are divided, a tree or the beginning of one.
    """
    return tree if mesh is None else jax.device_put(tree, _shardings(mesh, specs))


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
