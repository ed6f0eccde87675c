"""Episodes with everything that happened in them, for pictures: the states of the simulator itself.

`evaluate.run_episodes` keeps what statistics need. Here a few episodes are kept whole: the covered
area, the readings and the parts of the reward are those that the step function produced, none is
worked out again.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from sqn_jax.agent.networks import Params, QOutput, make_network
from sqn_jax.config import Algorithm, NetworkConfig
from sqn_jax.env import NUM_ACTIONS, EnvParams, EnvState, Observation
from sqn_jax.env.navigation import Info
from sqn_jax.evaluate import start_episode
from sqn_jax.rollout import Chance, Fleet, act_and_step, draw_chance


@struct.dataclass
class Recording:
    """E episodes of T steps. Index t of `states` and `observations` is before step t."""

    states: EnvState
    """[E, T + 1, ...] poses, goals, covered points."""
    observations: Observation
    """[E, T + 1, ...] what the agent saw, in 0..1 and with noise where there is any."""
    actions: Array
    """[E, T] int32."""
    rewards: Array
    """[E, T]."""
    info: Info
    """[E, T] each: what `navigation.step` says of a step, the parts of the reward among it."""
    outputs: QOutput
    """[E, T, ...] action values, skill decision, action values of each skill."""

    def episode(self, index: int) -> Recording:
        """One of them: the same arrays without the first axis."""
        chosen: Recording = jax.tree.map(lambda x: x[index], self)
        return chosen


@partial(jax.jit, static_argnames=("algo", "network_config"))
def record_episodes(
    keys: Array,
    params: Params,
    env_params: EnvParams,
    *,
    algo: Algorithm,
    network_config: NetworkConfig,
) -> Recording:
    """Drive greedy episodes and keep all of them.

    Tasks and noise are those that `evaluate.run_episodes` has for the same keys. How an episode
    goes on may differ from there, since sums are rounded in another order.

    Args:
        keys: [E] from `evaluate.episode_keys`.
        params: parameters of one network, without a seed axis.
        env_params: the world, with the noise it was made with.
        algo: which network the parameters belong to.
        network_config: its sizes.

    Returns:
        The episodes; a step takes about 1 kB on the maze and 6 kB in the cave.
    """
    network = make_network(algo, network_config, NUM_ACTIONS)
    advance = partial(
        act_and_step,
        network=network,
        params=params,
        epsilon=jnp.zeros(1),
        env_params=env_params,
    )

    def one(key: Array) -> Recording:
        drive_key, fleet = start_episode(key, network, env_params)
        chance = draw_chance(drive_key, env_params.max_steps, 1)

        def body(fleet: Fleet, chance: Chance) -> tuple[Fleet, Any]:
            after, (_, _, action, (reward, _, info), output) = advance(fleet, chance)
            return after, ((after.state, after.obs), action, reward, info, output)

        _, (seen, *steps) = jax.lax.scan(body, fleet, chance)
        states, observations = jax.tree.map(
            lambda first, later: jnp.concatenate([first[None], later])[:, 0],
            (fleet.state, fleet.obs),
            seen,
        )
        return Recording(states, observations, *jax.tree.map(lambda x: x[:, 0], steps))

    return jax.vmap(one)(keys)
