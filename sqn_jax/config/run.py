"""All settings of a run."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Literal

from sqn_jax.config.groups import (
    EnvConfig,
    EvalConfig,
    ExplorationConfig,
    LearnerConfig,
    NetworkConfig,
    RandomizationConfig,
    ReplayConfig,
)
from sqn_jax.config.map_names import MapSet, parse
from sqn_jax.config.validation import (
    MOST,
    require,
    require_known_choices,
    require_not_negative,
    require_positive,
    require_within_limits,
)

Algorithm = Literal["sqn", "r2d2", "dqn"]
Method = Literal["r2d2", "pqn"]


@dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    algo: Algorithm = "sqn"
    """The agent, named as in the paper by its network."""
    method: Method = "r2d2"
    """How it learns: R2D2 with replay, or recurrent PQN on fresh episodes."""
    map: str = "maze"
    """A map of the project by name, the path of a ROS map_server YAML file, a procedural map
    ("maze:7"), or several side by side, "maze*8,maze:0-14", here with eight times as many tasks on
    the first; evaluated is the first."""
    task_sampling: Literal["uniform", "learnability"] = "uniform"
    """Of several maps: tasks from all alike, or most from those on which about every other goal is
    reached."""
    start_from: str = ""
    """A trained policy to start from in place of random parameters: a run folder,
    "pretrained:sqn" or a file NAME.npz. Agent, network and what it sees are those of the policy, in
    place of the preset's."""
    seed: int = 0
    """Seed of the first run."""
    num_seeds: int = 1
    """Runs trained side by side in one program, with seeds seed, seed + 1, ..."""
    total_episodes: int = 10_000
    """Training episodes of each run."""
    num_envs: int = 50
    """Envs that run in parallel; each round is one whole episode of all of them."""
    updates_per_round: int = 50
    """r2d2: updates after each round."""
    rounds_per_chunk: int = 1
    """Rounds in one call of the compiled program; the host looks in between chunks."""
    checkpoint_minutes: float = 10.0
    """Minutes between checkpoints; one is always written at the end."""
    checkpoint_replay: bool = True
    """r2d2: save the replay, too; else a run resumes with an empty one, and differs."""
    max_skipped_updates: int = 100
    """Stop once more updates than this had a loss or gradient that is not finite."""
    env: EnvConfig = field(default_factory=EnvConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)

    def __post_init__(self) -> None:
        require_known_choices(self, "")
        # Equal maps are equal settings, however they were written.
        object.__setattr__(self, "map", str(self.maps))
        require(0 <= self.seed < 2**31, "seed", self.seed, "a number from 0 to 2147483647")
        for name in ("num_seeds", "num_envs", "updates_per_round", "rounds_per_chunk"):
            value = getattr(self, name)
            require(value >= 1, name, value, "at least 1")
        require(
            self.total_episodes >= self.num_envs,
            "total_episodes",
            self.total_episodes,
            f"at least num_envs ({self.num_envs}), one round",
        )
        require_within_limits(self, "")
        require(
            self.seed + self.num_seeds <= 2**31,
            "num_seeds",
            self.num_seeds,
            f"at most {2**31 - self.seed} from seed {self.seed} on",
        )
        require(
            self.num_rounds * self.num_envs <= MOST,
            "rounds_per_chunk",
            self.rounds_per_chunk,
            f"a run of at most {MOST:,} episodes, in full chunks of {self.num_envs} a round",
        )
        require_positive(self, "", "checkpoint_minutes")
        require_not_negative(self, "", "max_skipped_updates")
        if self.method == "r2d2":
            require(
                self.replay.capacity % self.num_envs == 0,
                "replay.capacity",
                self.replay.capacity,
                f"a multiple of num_envs ({self.num_envs}), which are stored a round at a time",
            )
        else:
            require(
                self.num_envs % self.learner.batch_size == 0,
                "learner.batch_size",
                self.learner.batch_size,
                f"a divisor of num_envs ({self.num_envs}) under the method pqn",
            )

    @functools.cached_property
    def maps(self) -> MapSet:
        """The maps that `map` names."""
        return parse(self.map)

    @property
    def num_rounds(self) -> int:
        """Rounds of the whole run; the last chunk may add a few to be full."""
        rounds = math.ceil(self.total_episodes / self.num_envs)
        return math.ceil(rounds / self.rounds_per_chunk) * self.rounds_per_chunk

    @property
    def num_chunks(self) -> int:
        """Calls of the compiled program in the whole run."""
        return self.num_rounds // self.rounds_per_chunk

    @property
    def averages_params(self) -> bool:
        """Whether the policy is an average of the parameters over the last updates."""
        return self.method == "pqn" and self.learner.average_share > 0
