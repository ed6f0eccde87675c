"""README.md of an exported policy: a model card with a header in YAML, as model hubs read it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sqn_jax.config import TrainConfig
from sqn_jax.export.description import observation_size, state_size
from sqn_jax.outside.reading import read_json
from sqn_jax.policies.pretrained import card_of, names_a_run
from sqn_jax.policies.run_policies import Policy

MAX_EVALUATION_BYTES = 2**24
EVALUATION = "evaluation.json"


@dataclass(frozen=True)
class Result:
    """What a policy reached in one kind of tasks."""

    suite: str
    """Map and kind of tasks."""
    episodes: int
    goal_radius: float
    """m."""
    success: float
    """Fraction of the episodes."""


def results_of(name: str, policy: Policy) -> list[Result]:
    """What is on record of a policy: on its card, or in `evaluation.json` of its run.

    Args:
        name: as the user gave it.
        policy: of one seed.

    Raises:
        ValueError: the record cannot be read.
    """
    try:
        if names_a_run(name):
            return _of_run(Path(name) / EVALUATION, policy)
        return [
            Result(
                f"{entry['map']}, {entry['tasks']}",
                int(entry["episodes"]),
                float(entry["goal_radius_m"]),
                float(entry["success"]["mean"]),
            )
            for entry in card_of(name).get("evaluation", [])
        ]
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"{name}: its evaluation lacks {error}, expected results") from None


def _of_run(path: Path, policy: Policy) -> list[Result]:
    if not path.exists():
        return []
    evaluation = read_json(path, MAX_EVALUATION_BYTES, "an evaluation", follow=False)
    seed = policy.config.seed
    entries = [
        entry
        for entry in evaluation["results"]
        if entry["algorithm"] == policy.config.algo and seed in entry["training_seeds"]
    ]
    return [
        Result(
            f"{entry['map']}, {entry['tasks']}",
            int(entry["episodes"]) * len(entry["eval_seeds"]),
            float(entry["goal_radius"]),
            float(entry["success_per_seed"][entry["training_seeds"].index(seed)]),
        )
        for entry in entries
        if not (entry["velocity_noise"] or entry["range_noise"])
    ]


def model_card(policy: Policy, results: Sequence[Result], terms: str = "") -> str:
    """The text of README.md; `terms` is a license by its short name, if one is known."""
    sections = [
        _header(policy, results, terms),
        f"# {policy.name}",
        _introduction(policy.config),
        _robot(policy.config),
        _results(policy.config, results),
        _failures(policy.config, results),
        _use(policy.config),
    ]
    return "\n\n".join(sections) + "\n"


def _header(policy: Policy, results: Sequence[Result], terms: str) -> str:
    entries = [
        {
            "task": {"type": "reinforcement-learning", "name": "mapless navigation"},
            "dataset": {"type": "sqn_jax", "name": result.suite},
            "metrics": [
                {
                    "type": "success_rate",
                    "value": round(result.success, 4),
                    "name": f"success within {result.goal_radius:g} m",
                }
            ],
        }
        for result in results
    ]
    facts: dict[str, Any] = {
        "library_name": "sqn_jax",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["robotics", "mapless-navigation", "onnx", policy.config.algo],
    }
    if terms:
        facts["license"] = terms
    if entries:
        facts["model-index"] = [{"name": policy.name, "results": entries}]
    return f"---\n{yaml.safe_dump(facts, sort_keys=False)}---"


def _introduction(config: TrainConfig) -> str:
    agent, rate = config.algo.upper(), 1 / config.env.time_step
    return f"""A policy of sqn_jax (agent {agent}) for mapless navigation: from the ranges around a
robot and the distance and direction of its goal to one of five commands, {rate:g} times a second.
Trained in simulation on `{config.maps.without_folders()}`.

**Not safety rated.** The network has no guarantee of any kind. Put a bumper, an emergency stop or a
certified scanner between it and the motors, and people out of reach of both."""


def _robot(config: TrainConfig) -> str:
    env = config.env
    clipped = env.goal_distance_encoding == "clipped"
    far = f"up to {env.max_goal_distance:g} m" if clipped else "of any size"
    return f"""## The robot it is for

| What | Trained with |
|---|---|
| Body | a disc of {env.robot_radius:g} m radius that turns in place |
| Speeds | {env.forward_speed:g} m/s forward, {env.backward_speed:g} m/s backward, \
{env.turn_rate:.4g} rad/s; reached at once, no inertia |
| Time step | {env.time_step:g} s: {env.forward_speed * env.time_step:g} m or \
{math.degrees(env.turn_rate * env.time_step):.3g} degrees |
| Ranges | {env.num_beams} directions over {env.field_of_view_deg:g} degrees, up to \
{env.max_range:g} m, measured from the center of the body |
| Goal | distance {far} and heading, known at each step; reached \
within {env.goal_radius:g} m |

A slower robot takes the same path if each command is held for longer: a tenth of the speeds for ten
times the time."""


def _results(config: TrainConfig, results: Sequence[Result]) -> str:
    if not results:
        return "## Results\n\nNone are on record: evaluate it with `sqn evaluate`."
    lines = [
        f"| {result.suite} | {result.episodes} | {result.goal_radius:g} m | {result.success:.3f} |"
        for result in results
    ]
    head = "| Suite | Episodes | Goal radius | Success |\n|---|---|---|---|"
    return "\n".join(
        ["## Results", "", "Greedy episodes in simulation, without noise.", "", head, *lines]
    )


def _failures(config: TrainConfig, results: Sequence[Result]) -> str:
    env = config.env
    blind = 360 - env.field_of_view_deg
    lines = [
        f"- It does not see {blind:g} degrees behind it, and drives backward all the same.",
        "- It has never met anything that moves, glass, steps, or a scan plane above an obstacle.",
        "- On maps unlike those it was trained on it arrives far less often, and a wall\n"
        "  follower can be better. Evaluate it on yours, with your radius and your noise.",
        "- It may turn to and fro in front of an obstacle for ever. Give each goal a time limit.",
        "- It goes on moving at the goal: stop it there.",
    ]
    failed = [result for result in results if result.success < 1]
    lines += [
        f"- {result.suite}: {1 - result.success:.1%} of the episodes did not arrive."
        for result in failed
    ]
    return "\n".join(["## Known failures", "", *lines])


def _use(config: TrainConfig) -> str:
    more, call = "", "ranges, distance, heading, hidden"
    if config.network.motion_inputs:
        more = (
            " At the end of `obs` stands 1 if the last command\n  was a move and the robot did not "
            "move, else 0; `h_in` holds the last action, too."
        )
        call += ", refused"
    return f"""## Use

- `policy.onnx`: any ONNX runtime, opset 17. Inputs `obs` [1, {observation_size(config)}], ranges in
  m, the goal's distance in m and heading in rad, and `h_in` [1, 1, {state_size(config)}], zeros at
  each new goal; outputs `actions` [[m/s, rad/s]], `action_index`, `q_values`, `skill_weights`,
  `h_out`.{more} The order of the beams, the commands and all else that a robot needs are
  in its metadata. Ranges may be infinite or NaN where nothing is hit. With value rescaling,
  Q-values are those of the rescaled return.
- `sqn_policy.py` with `params.safetensors` and `config.json`: Python 3.8 and NumPy:
  `policy.act({call})`.
- `reference.npz`: observations, hidden states, Q-values and actions of a rollout, to compare with.
- `SHA256SUMS`: `sha256sum -c SHA256SUMS` says whether a file has changed;
  `sqn export --check FOLDER` runs both and compares."""
