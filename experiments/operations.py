"""How much arithmetic one R2D2 update asks for, from the shapes alone."""

from __future__ import annotations

from sqn_jax.config import Algorithm, NetworkConfig


def multiply_adds(
    algo: Algorithm, network: NetworkConfig, *, num_beams: int, goal_size: int, num_actions: int
) -> tuple[int, int, int]:
    """Multiplications in the matrix products of a network for one observation.

    Returns:
        Those of the layers that look at the observation, further ones up to the recurrent state
        (0 for the DQN, which has none), and those from there to the Q-values.
    """
    size = network.hidden_size
    first = (num_beams + goal_size) * size
    features = 2 * size * size
    if algo == "dqn":
        width = size * network.dqn_width_factor
        return first, 0, features + 2 * size * width + width * width + width * num_actions
    gru = 2 * size * 3 * size + size * 3 * size
    head = size * size + size * num_actions
    if algo == "r2d2":
        return first, features + gru, head
    decision = size * size + size * network.num_skills
    return first, features + gru, decision + network.num_skills * head


def update_operations(
    algo: Algorithm,
    network: NetworkConfig,
    *,
    num_beams: int,
    goal_size: int,
    num_actions: int,
    num_steps: int,
    batch_size: int,
    burn_in_length: int,
) -> int:
    """Floating-point operations in the matrix products that one R2D2 update asks for.

    A product [M, K] x [K, N] counts 2 M K N. Counted are, for the `num_steps` + 1 -
    `burn_in_length` observations of each episode that are learned from: the online network
    forward; the online network backward, twice that (the gradients of inputs and of weights; once
    for the layers that look at the observation, whose input needs none); the target network
    forward. And for the observations of the burn-in: both networks forward, up to the recurrent
    state.

    Not counted: all that is no matrix product (activations, gates, softmax, targets, optimizer,
    drawing). The number says what is asked for, however a program goes about it.

    Args:
        algo: the agent.
        network: its sizes; layer normalization changes nothing.
        num_beams: range readings of an observation.
        goal_size: numbers that tell the goal.
        num_actions: actions.
        num_steps: steps an episode.
        batch_size: episodes an update.
        burn_in_length: steps that only warm up the recurrent state.
    """
    first, memory, head = multiply_adds(
        algo, network, num_beams=num_beams, goal_size=goal_size, num_actions=num_actions
    )
    learned = (num_steps + 1 - burn_in_length) * batch_size
    online = learned * (2 * first + 3 * (memory + head))
    target = learned * (first + memory + head)
    warmed_up = burn_in_length * batch_size if memory else 0
    return 2 * (online + target + 2 * warmed_up * (first + memory))
