"""The groups of settings: robot, world, network, replay, learner, exploration, evaluation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from sqn_jax.config.validation import (
    require,
    require_known_choices,
    require_not_negative,
    require_positive,
    require_within_limits,
)


@dataclass(frozen=True)
class EnvConfig:
    """The robot, its sensors and its reward (paper sections III-A, III-C, IV-A, IV-B)."""

    num_beams: int = 71
    """Range beams, evenly spaced over the field of view."""
    field_of_view_deg: float = 350.0
    """Angle from the first to the last beam, centered on the heading, degrees."""
    max_range: float = 5.0
    """Farthest range a beam reads, m."""
    forward_speed: float = 2.5
    """Speed of the action "forward", m/s."""
    backward_speed: float = 1.25
    """Speed of the action "backward", m/s, given as a positive number."""
    turn_rate: float = math.pi
    """Turn rate of the actions "turn left" and "turn right", rad/s."""
    time_step: float = 0.1
    """Seconds a step."""
    robot_radius: float = 0.1
    """Radius of the robot's body, m; 0 is a point."""
    bumper: float = 0.0
    """How near, m from its body, a robot lets come what its beams show: it does not make the move,
    and is told that it was refused. 0: moves are refused where the body touches something."""
    scan_margin: float = 0.0
    """How much thicker obstacles are in the scan that the agent sees, m; see `env.scan_margin`."""
    goal_radius: float = 0.3
    """The goal counts as reached within this distance, m."""
    max_goal_distance: float = 24.0
    """Goal distance at which the normalized observation reaches 1, m (17 m x sqrt 2)."""
    goal_distance_encoding: Literal["clipped", "rational"] = "clipped"
    """Goal distance d as d / max_goal_distance, at most 1, or as d / (d + goal_distance_scale),
    which tells any two distances apart."""
    goal_distance_scale: float = 5.0
    """rational: goal distance at which the observation is 1/2, m; here the range of the beams."""
    heading_encoding: Literal["linear", "sincos"] = "linear"
    """Goal heading as one number (psi + pi) / 2 pi, or as sine and cosine scaled to 0..1."""
    max_steps: int = 0
    """Steps an episode; 0 takes the map's own limit (400, in the cave 1200)."""
    coverage_cell: float = 0.325
    """Distance of the points on which the covered area is counted, m."""
    ray_sectors: int = 8
    """Directions in the free-space table of the ray caster; a multiple of 4."""
    ray_iterations: int = 8
    """Free rectangles a ray may cross before its reading is cut short."""
    velocity_noise: float = 0.0
    """Sigma of Gaussian noise on the executed velocity."""
    velocity_noise_unit: Literal["relative", "absolute"] = "relative"
    """Sigma as a fraction of (forward_speed, turn_rate), or in m/s and rad/s."""
    range_noise: float = 0.0
    """Half-width p of the uniform noise on the observed ranges."""
    range_noise_unit: Literal["relative", "absolute"] = "relative"
    """Reading x (1 + U(-p, p)), or reading + max_range x U(-p, p)."""
    near_goal_fraction: float = 0.0
    """Fraction of training tasks whose goal is one of the spawn points nearest to the start."""
    reward_navigation: float = 2.0
    """Weight of the reachability-aware navigation term (paper eq. 9)."""
    reward_exploration: float = 1.0
    """Weight of newly covered area, 1/m2 (paper eq. 7 and 9)."""
    reward_time: float = 0.2
    """Weight of the constant penalty of -1 a step (paper eq. 9)."""
    reward_collision: float = 0.0
    """Weight of a penalty of -1 for each collision; the paper has none."""

    def __post_init__(self) -> None:
        distances = ("max_range", "goal_radius", "max_goal_distance", "goal_distance_scale")
        for name in (*distances, "time_step", "coverage_cell"):
            require_positive(self, "env", name)
        speeds_and_size = ("forward_speed", "backward_speed", "turn_rate", "robot_radius")
        margins = ("bumper", "scan_margin", "velocity_noise", "range_noise")
        for name in (*speeds_and_size, *margins):
            require_not_negative(self, "env", name)
        terms = ("navigation", "exploration", "time", "collision")
        for name in (f"reward_{term}" for term in terms):
            value = getattr(self, name)
            require(math.isfinite(value), f"env.{name}", value, "a finite number")
        require_known_choices(self, "env")
        value = self.near_goal_fraction
        require(0 <= value <= 1, "env.near_goal_fraction", value, "a number from 0 to 1")
        require(self.num_beams >= 2, "env.num_beams", self.num_beams, "at least 2")
        require(
            0 < self.field_of_view_deg < 360,
            "env.field_of_view_deg",
            self.field_of_view_deg,
            "more than 0 and less than 360 degrees",
        )
        require(self.max_steps >= 0, "env.max_steps", self.max_steps, "0 or a positive number")
        require(
            self.ray_sectors >= 4 and self.ray_sectors % 4 == 0,
            "env.ray_sectors",
            self.ray_sectors,
            "a positive multiple of 4",
        )
        require(self.ray_iterations >= 1, "env.ray_iterations", self.ray_iterations, "at least 1")
        require_within_limits(self, "env")


@dataclass(frozen=True)
class RandomizationConfig:
    """How the worlds of the parallel robots differ in training (domain randomization).

    Each robot keeps its own world for the whole run. Evaluations have none of this.
    """

    velocity_noise: float = 0.0
    """Sigma of each robot's velocity noise, from 0 to this; in place of `env.velocity_noise`."""
    range_noise: float = 0.0
    """Half-width of each robot's range noise, from 0 to this; in place of `env.range_noise`."""
    speed: float = 0.0
    """Each robot's speeds and turn rate are up to this fraction faster or slower."""
    mirror: bool = False
    """Half of the robots live in the mirror image of the map."""

    def __post_init__(self) -> None:
        for name in ("velocity_noise", "range_noise"):
            require_not_negative(self, "randomization", name)
        require(0 <= self.speed <= 1, "randomization.speed", self.speed, "a number from 0 to 1")
        require_within_limits(self, "randomization")


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks (paper sections III-B and IV-C)."""

    hidden_size: int = 128
    """Width of every layer and of the GRU."""
    num_skills: int = 2
    """Latent skill policies N of the SQN."""
    layer_norm: bool = False
    """Layer normalization before each ReLU; recurrent PQN needs it, the paper has none."""
    dqn_width_factor: int = 3
    """How much wider the DQN's layers after the features are (paper section IV-D)."""
    motion_inputs: bool = False
    """The agent is also told its last action, and whether that was a move that was refused."""
    cell: Literal["gru", "refined_gru"] = "gru"
    """sqn, r2d2: the recurrent unit; the refined one scales its candidate by the input and learns
    how its update gate saturates."""
    gate: Literal["learned", "equal", "reachable"] = "learned"
    """sqn: how the skill weights come about: learned (eq. 3 and 4), all equal, or set by hand, all
    weight on the first of two skills while the goal is reachable (eq. 8) and else on the second."""
    gate_temperature: float = 1.0
    """learned gate: what the logits of the skill decision are divided by before the softmax."""
    gate_balance_rate: float = 0.0
    """learned gate: step by which a bias on the logit of each skill moves after an update, up for a
    skill with less than its equal part of the weight and else down; 0: no bias."""
    embeddings: bool = True
    """sqn: the skill decision and each skill add an embedding of their own to the perception."""
    r2d2_width_factor: int = 1
    """r2d2: how much wider the hidden layer of the head is; 3 is as wide as those of two skills and
    the decision between them."""

    def __post_init__(self) -> None:
        require_known_choices(self, "network")
        for name in ("hidden_size", "num_skills", "dqn_width_factor", "r2d2_width_factor"):
            value = getattr(self, name)
            require(value >= 1, f"network.{name}", value, "at least 1")
        require_positive(self, "network", "gate_temperature")
        require_not_negative(self, "network", "gate_balance_rate")
        require(
            self.gate != "reachable" or self.num_skills == 2,
            "network.num_skills",
            self.num_skills,
            "2 with network.gate reachable: one skill for a goal that is, one for all else",
        )
        require_within_limits(self, "network")


@dataclass(frozen=True)
class ReplayConfig:
    """Whole-episode replay with priorities (used by the method `r2d2`)."""

    capacity: int = 10_000
    """Episodes in the replay memory; the oldest make room for the newest."""
    min_episodes: int = 100
    """Updates begin once this many episodes are stored."""
    prioritized: bool = True
    """Draw sequences by priority; otherwise uniformly."""
    priority_exponent: float = 0.9
    """Exponent on the priorities when drawing (R2D2, table 2)."""
    importance_exponent: float = 0.6
    """Exponent of the importance-sampling weights (R2D2, table 2)."""
    max_priority_weight: float = 0.9
    """Priority of a sequence: this fraction of the largest TD error, the rest of the mean one."""

    def __post_init__(self) -> None:
        require(self.capacity >= 1, "replay.capacity", self.capacity, "at least 1")
        require(
            1 <= self.min_episodes <= self.capacity,
            "replay.min_episodes",
            self.min_episodes,
            f"1 to replay.capacity ({self.capacity})",
        )
        for name in ("priority_exponent", "importance_exponent", "max_priority_weight"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"replay.{name}", value, "a number from 0 to 1")
        require_within_limits(self, "replay")


@dataclass(frozen=True)
class LearnerConfig:
    """The update rule. Fields used by one method only say so."""

    batch_size: int = 64
    """Robots an update: whole episodes for r2d2, windows of them for pqn."""
    learning_rate: float = 3e-4
    """Adam's step size at the start."""
    learning_rate_schedule: Literal["constant", "linear"] = "constant"
    """Constant, or falling linearly to 0 over the run."""
    adam_epsilon: float = 1e-5
    """Adam's epsilon."""
    max_grad_norm: float = 40.0
    """Gradients are scaled down to this global norm."""
    discount: float = 0.997
    """Discount factor gamma (at the end of the run, if `discount_start` says otherwise)."""
    discount_start: float = 0.0
    """Discount at the start, from where the horizon grows geometrically; 0: constant."""
    value_rescaling: bool = True
    """Learn h(Q) instead of Q (R2D2, eq. 1)."""
    n_step: int = 5
    """r2d2: steps of reward before the bootstrap."""
    double_q: bool = True
    """r2d2: the online network picks the bootstrap action, the target network values it."""
    burn_in_length: int = 10
    """r2d2: steps at the start of a sequence that only warm up the recurrent state."""
    target_update_rate: float = 0.002
    """r2d2: Polyak coefficient tau of the target network."""
    trace_decay: float = 0.8
    """pqn: lambda of the Q(lambda) returns."""
    average_share: float = 0.0
    """pqn: evaluate the parameters averaged over this last fraction of updates; 0: the latest."""
    window_length: int = 0
    """pqn: steps between updates, a divisor of the episode; 0 is the whole episode."""
    num_passes: int = 1
    """pqn: how often each step is learned from."""
    restart_at_goal: bool = False
    """pqn: a robot that is at its goal at the end of a window gets a new task."""
    advantage_learning: float = 0.0
    """Alpha of advantage learning, which widens the gaps between actions; 0: plain Q-learning."""
    skill_loss: Literal["mixture", "each"] = "mixture"
    """sqn: what is compared with the target: the weighted sum of the skills (eq. 6), or each skill,
    its squared error weighted by its skill weight."""
    gate_entropy_weight: float = 0.0
    """sqn: c of the loss term c (mean H(eta) - H(mean eta)), which makes each decision clear and
    uses all skills; 0: no term."""

    def __post_init__(self) -> None:
        require_known_choices(self, "learner")
        for name in ("learning_rate", "adam_epsilon", "max_grad_norm"):
            require_positive(self, "learner", name)
        for name in ("batch_size", "n_step", "num_passes"):
            value = getattr(self, name)
            require(value >= 1, f"learner.{name}", value, "at least 1")
        for name in ("burn_in_length", "window_length"):
            value = getattr(self, name)
            require(value >= 0, f"learner.{name}", value, "0 or a positive number")
        require_not_negative(self, "learner", "gate_entropy_weight")
        fractions = ("trace_decay", "average_share", "advantage_learning")
        for name in ("discount", "discount_start", *fractions):
            value = getattr(self, name)
            require(0 <= value <= 1, f"learner.{name}", value, "a number from 0 to 1")
        value = self.target_update_rate
        require(0 < value <= 1, "learner.target_update_rate", value, "more than 0, at most 1")
        require_within_limits(self, "learner")


@dataclass(frozen=True)
class ExplorationConfig:
    """Epsilon-greedy exploration, falling linearly (paper section IV-C)."""

    epsilon_start: float = 0.4
    """Probability of a random action at the start."""
    epsilon_end: float = 0.1
    """Probability of a random action once it has fallen."""
    decay_fraction: float = 1.0
    """Fraction of the run over which epsilon falls."""
    ladder: bool = False
    """Give each parallel robot its own epsilon, evenly from 0 to 2 times the schedule's."""

    def __post_init__(self) -> None:
        for name in ("epsilon_start", "epsilon_end"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"exploration.{name}", value, "a number from 0 to 1")
        value = self.decay_fraction
        require(0 < value <= 1, "exploration.decay_fraction", value, "more than 0, at most 1")
        require_within_limits(self, "exploration")


@dataclass(frozen=True)
class EvalConfig:
    """The evaluations of a training run: at its end, and at points of its learning curve."""

    episodes: int = 100
    """Greedy episodes from the evaluation points, and as many from random spawn pairs."""
    seed: int = 1_000
    """Seed of the starts and goals; independent of the training seed."""
    curve_points: int = 20
    """How often, evenly over the run, the policy is evaluated while it is trained; 0: never."""
    curve_episodes: int = 100
    """Greedy episodes from the evaluation points at each such time, the same at all."""

    def __post_init__(self) -> None:
        require_within_limits(self, "eval")
