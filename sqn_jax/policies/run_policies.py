"""Trained policies as an evaluation takes them: read from a run folder, nothing else needed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from sqn_jax import config as configs
from sqn_jax.agent.networks import Params
from sqn_jax.config import TrainConfig
from sqn_jax.config.validation import LIMITS, require_limits
from sqn_jax.storage.manifest import Origin, leaves_of
from sqn_jax.storage.run_folder import CHECKPOINTS, RunFolder
from sqn_jax.training.devices import put
from sqn_jax.training.state import RunnerState, params_shapes

WhichParams = Literal["shipped", "latest", "average", "target"]
"""Which parameters of a run act: those that it ships (the average where it keeps one, else the
latest), the latest, the average of `TrainConfig.averages_params`, or those of the target network of
the method `r2d2`."""


@dataclass(frozen=True)
class Policy:
    """The policies of one training run, one for each of its seeds."""

    name: str
    """The run folder's name."""
    config: TrainConfig
    """How they were trained: network, robot, sensors."""
    params: tuple[Params, ...]
    """Parameters, one tree a training seed."""

    @property
    def training_seeds(self) -> tuple[int, ...]:
        """The seeds, in the order of `params`."""
        return tuple(self.config.seed + index for index in range(self.config.num_seeds))


def load_policy(
    run_dir: Path, checkpoint: int | str = "newest", params: WhichParams = "shipped"
) -> Policy:
    """Read a policy from a checkpoint of a run folder.

    Args:
        run_dir: the folder.
        checkpoint: "newest", "best" (by success in training, over the chunks since the one before)
            or the number of chunks it was saved after.
        params: which parameters.

    Raises:
        ValueError: the run keeps no such parameters, it is no run folder, its config is unusable,
            or it holds no such checkpoint, or a damaged one.
        Mismatch: the checkpoint is of another run than the config says.
    """
    # Orbax takes a fifth of a second to import, which no `pretrained:NAME` needs.
    from sqn_jax.storage.checkpoint import Checkpoints

    _, config = RunFolder.open(run_dir)
    if not (run_dir / CHECKPOINTS).is_dir():
        raise ValueError(f"run folder {run_dir}: holds no checkpoint, train it first")
    with Checkpoints(run_dir, Origin(config)) as checkpoints:
        restored = checkpoints.restore_policy(
            params_shapes(config), averaged=_is_averaged(params, config), which=checkpoint
        )
    require_finite(restored, f"run folder {run_dir}")
    return Policy(run_dir.resolve().name, config, seeds_of(restored, config))


def _is_averaged(params: WhichParams, config: TrainConfig) -> bool:
    """Whether the parameters are those that follow the latest ones slowly."""
    if params == "average" and not config.averages_params:
        raise ValueError(
            "--params average: this run keeps none (learner.average_share of the method pqn)"
        )
    if params == "target" and config.method != "r2d2":
        raise ValueError(f"--params target: a run of the method {config.method} has no target")
    return params in ("average", "target") or (params == "shipped" and config.averages_params)


def require_finite(params: Params, source: str) -> None:
    """Refuse parameters that are not finite: a robot would take any action as the best.

    Args:
        params: the tree.
        source: what the error calls it.

    Raises:
        ValueError: one line naming an array.
    """
    for path, leaf in leaves_of(params):
        if not np.isfinite(leaf).all():
            raise ValueError(f"{source}: array {path} holds numbers that are not finite")


def seeds_of(params: Params, config: TrainConfig) -> tuple[Params, ...]:
    """The parameters of each seed, out of those of a whole run."""
    if config.num_seeds == 1:
        return (params,)
    return tuple(jax.tree.map(lambda x, i=i: x[i], params) for i in range(config.num_seeds))


def of_seed(policy: Policy, seed: int | None) -> Policy:
    """The policy of one training seed, whose config says it.

    Raises:
        ValueError: there are several and none is named, or there is no such seed.
    """
    seeds = policy.training_seeds
    if seed is None and len(seeds) > 1:
        raise ValueError(
            f"{policy.name}: has the training seeds {seeds[0]} to {seeds[-1]}, expected --seed "
            "with one of them"
        )
    if seed is not None and seed not in seeds:
        known = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
        raise ValueError(f"{policy.name}: has no training seed {seed}, expected {known}")
    chosen = seeds[0] if seed is None else seed
    config = dataclasses.replace(policy.config, seed=chosen, num_seeds=1)
    return Policy(policy.name, config, (policy.params[seeds.index(chosen)],))


def with_bumper(policy: Policy, bumper: float | None) -> Policy:
    """The policy on a robot with a virtual bumper (`env.bumper`), in m; None: as it was trained.

    Raises:
        ValueError: the number is out of range.
    """
    if bumper is None:
        return policy
    require_limits(bumper, "--bumper", *LIMITS["env.bumper"])
    env = dataclasses.replace(policy.config.env, bumper=bumper)
    return dataclasses.replace(policy, config=dataclasses.replace(policy.config, env=env))


def network_settings(config: TrainConfig) -> dict[str, Any]:
    """The settings that the parameters of a policy belong to, by their dotted names."""
    settings = configs.flat(configs.to_dict(config))
    names = ["algo", "env.num_beams", "env.heading_encoding", "env.goal_distance_encoding"]
    names += [name for name in settings if name.startswith("network.")]
    return {name: settings[name] for name in names}


def settings_to_start_from(config: TrainConfig) -> dict[str, Any]:
    """What a run takes over from a policy it starts from, unless it says something else.

    Those of `network_settings`, and the scales of the goal's distance, which may be changed.
    """
    settings = configs.flat(configs.to_dict(config))
    scales = ("env.max_goal_distance", "env.goal_distance_scale")
    return network_settings(config) | {name: settings[name] for name in scales}


def require_same_network(policy: Policy, config: TrainConfig) -> None:
    """Check that a run can start from a policy.

    Raises:
        ValueError: the policy is of another network, or sees other observations.
    """
    ours = network_settings(config)
    for name, theirs in network_settings(policy.config).items():
        if theirs != ours[name]:
            raise ValueError(
                f"--start-from {config.start_from}: its {name} is {theirs}, here it is "
                f"{ours[name]} (--{name.replace('_', '-')})"
            )


def started_from(runner: RunnerState, policy: Policy) -> RunnerState:
    """The state of a new run whose parameters are those of a policy, of its first seed."""

    def filled(fresh: Params) -> Params:
        return jax.tree.map(
            lambda mine, theirs: put(
                jnp.array(jnp.broadcast_to(theirs, mine.shape)), mine.sharding
            ),
            fresh,
            policy.params[0],
        )

    learner = runner.learner
    target = None if learner.target_params is None else filled(learner.target_params)
    learner = dataclasses.replace(learner, params=filled(learner.params), target_params=target)
    return dataclasses.replace(runner, learner=learner)
