"""A trained policy that acts: one step of one robot at a time, greedily."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import cast

import jax
import jax.numpy as jnp
from jax import Array

from sqn_jax.agent.networks import HasObservation, Params, QNetwork, QOutput, initial_carry
from sqn_jax.config import TrainConfig
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.policies.run_policies import of_seed
from sqn_jax.training.motion import MOTION_SIZE, with_motion
from sqn_jax.training.state import network_of


@dataclass(frozen=True, eq=False)
class GreedyPolicy:
    """One trained network; it takes the action of the largest value.

    Example:
        >>> policy = load_policy("pretrained:sqn")
        >>> carry = policy.start()
        >>> action, carry = policy.act(obs, carry, refused=False)
    """

    name: str
    config: TrainConfig
    """How it was trained: network, robot, sensors."""
    params: Params

    def start(self) -> Array:
        """The recurrent state at the start of an episode: `act` hands it on.

        [H], or with `network.motion_inputs` [H + A], of which the last A are the last action.
        """
        carry = initial_carry(self.config.network, 1)[0]
        actions = MOTION_SIZE - 1 if self.config.network.motion_inputs else 0
        return jnp.concatenate([carry, jnp.zeros(actions)])

    def act(
        self, obs: HasObservation, carry: Array, *, refused: bool | Array | None = None
    ) -> tuple[Array, Array]:
        """Choose an action.

        Args:
            obs: what `sqn_jax.reset` and `sqn_jax.step` return, of one robot.
            carry: from `start` or the step before.
            refused: whether the last move failed, `info["refused"]` of `sqn_jax.step`; False at
                first. A policy with `network.motion_inputs` needs it, others ignore it.

        Returns:
            The action, 0 to 4, and the next carry.

        Raises:
            ValueError: the policy needs `refused`, and it is not given.
        """
        carry, output = self.step(obs, carry, refused=refused)
        return output.q_values.argmax(), carry

    def step(
        self, obs: HasObservation, carry: Array, *, refused: bool | Array | None = None
    ) -> tuple[Array, QOutput]:
        """The next carry and all that the network says of an observation, without batch axes.

        See `act`; the action in the carry is that of the largest value.
        """
        if refused is None and self.config.network.motion_inputs:
            raise ValueError(
                f"policy {self.name} has network.motion_inputs, expected refused=False at first "
                "and then info['refused'] of the step before"
            )
        return cast(
            tuple[Array, QOutput],
            step_policy(
                self.params,
                obs,
                carry,
                jnp.asarray(False if refused is None else refused),
                network_of(self.config),
            ),
        )


@partial(jax.jit, static_argnames="network")
def step_policy(
    params: Params, obs: HasObservation, carry: Array, refused: Array, network: QNetwork
) -> tuple[Array, QOutput]:
    """One step of a policy for one robot, without axes of time and batch; see `GreedyPolicy`."""
    size = network.config.hidden_size
    if not network.config.motion_inputs:
        return step_network(params, obs, carry, network)
    carry, output = step_network(
        params, with_motion(obs, carry[size:], refused), carry[:size], network
    )
    taken = jax.nn.one_hot(output.q_values.argmax(), MOTION_SIZE - 1)
    return jnp.concatenate([carry, taken]), output


@partial(jax.jit, static_argnames="network")
def step_network(
    params: Params, obs: HasObservation, carry: Array, network: QNetwork
) -> tuple[Array, QOutput]:
    """One step of a network for one robot, without axes of time and batch."""
    sequence = jax.tree.map(lambda x: jnp.asarray(x)[None, None], obs)
    carry, output = network.apply(params, sequence, carry[None])
    return carry[0], jax.tree.map(lambda x: x[0, 0], output)


def load_policy(name: str, *, seed: int | None = None) -> GreedyPolicy:
    """A trained policy by the name a user gives, ready to act.

    Args:
        name: a run folder, `pretrained:NAME`, or a file NAME.npz.
        seed: the training seed, of a run with several.

    Raises:
        ValueError: there is none, it is damaged, or it has several seeds and none is named.
    """
    policy = of_seed(find_policy(name), seed)
    return GreedyPolicy(policy.name, policy.config, policy.params[0])
