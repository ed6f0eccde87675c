"""Networks, exploration, replay, returns, losses and the two learning methods; pure functions."""

from sqn_jax.agent.experience import Episodes
from sqn_jax.agent.networks import Params, QNetwork, QOutput, initial_carry, make_network

__all__ = ["Episodes", "Params", "QNetwork", "QOutput", "initial_carry", "make_network"]
