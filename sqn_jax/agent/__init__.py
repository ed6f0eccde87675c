"""Networks, exploration, replay, returns, losses and the two learning methods; pure functions."""

from sqn_jax.agent.networks import Params, QNetwork, QOutput, initial_carry, make_network
from sqn_jax.agent.trajectory import Trajectory

__all__ = ["Params", "QNetwork", "QOutput", "Trajectory", "initial_carry", "make_network"]
