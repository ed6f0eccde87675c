"""Settings refuse what they cannot use, in one line that names them; presets hold their values."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sqn_jax import config as config_module
from sqn_jax.config import EnvConfig, LearnerConfig, ReplayConfig, TrainConfig
from sqn_jax.config.presets import PRESETS

# Weights of the reward may be negative.
SIGNED = {f"env.reward_{term}" for term in ("navigation", "exploration", "time", "collision")}
# Below these whole numbers, and below 0 elsewhere, nothing is accepted.
AT_LEAST_ONE = {
    *("env.ray_iterations", "network.hidden_size", "network.num_skills"),
    *("network.dqn_width_factor", "replay.capacity", "replay.min_episodes"),
    "network.r2d2_width_factor",
    *("learner.batch_size", "learner.n_step", "learner.num_passes", "eval.episodes"),
    "eval.curve_episodes",
    *("num_seeds", "total_episodes", "num_envs", "updates_per_round", "rounds_per_chunk"),
}
POSITIVE = {
    *("env.max_range", "env.time_step", "env.goal_radius", "env.max_goal_distance"),
    *("env.coverage_cell", "env.field_of_view_deg", "learner.learning_rate"),
    *("env.goal_distance_scale", "network.gate_temperature"),
    *("learner.adam_epsilon", "learner.max_grad_norm", "learner.target_update_rate"),
    *("exploration.decay_fraction", "checkpoint_minutes"),
}
AT_MOST_ONE = {
    *("replay.priority_exponent", "replay.importance_exponent", "replay.max_priority_weight"),
    *(
        "learner.discount",
        "learner.discount_start",
        "learner.trace_decay",
        "learner.target_update_rate",
    ),
    *(
        "env.near_goal_fraction",
        "exploration.epsilon_start",
        "exploration.epsilon_end",
        "exploration.decay_fraction",
    ),
}


def leaves(cls: type = TrainConfig, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and type of every setting."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from leaves(hints[field.name], f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", hints[field.name]


LEAVES = dict(leaves())
NUMBERS = [name for name, kind in LEAVES.items() if kind in (int, float)]
FLOATS = [name for name, kind in LEAVES.items() if kind is float]
INTEGERS = [name for name, kind in LEAVES.items() if kind is int]
CHOICES = [name for name, kind in LEAVES.items() if typing.get_origin(kind) is typing.Literal]


def with_value(name: str, value: Any) -> dict[str, Any]:
    """The nested mapping that sets one dotted field."""
    group, _, field = name.rpartition(".")
    return {group: {field: value}} if group else {field: value}


def refusal(name: str, value: Any) -> str:
    """The one line with which a value is refused; it begins with the field's full name."""
    with pytest.raises(ValueError, match="expected") as caught:
        config_module.from_dict(with_value(name, value))
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{name} is ")
    assert repr(value) in message
    return message


def test_every_kind_of_setting_is_known_to_these_tests() -> None:
    kinds = {name: kind for name, kind in LEAVES.items() if kind not in (int, float, bool, str)}
    assert set(kinds) == set(CHOICES)
    assert {*SIGNED, *AT_LEAST_ONE, *POSITIVE, *AT_MOST_ONE} <= set(NUMBERS)
    assert len(NUMBERS) > 40


@pytest.mark.parametrize("name", [name for name in NUMBERS if name not in SIGNED])
def test_a_negative_number_is_refused(name: str) -> None:
    refusal(name, -1 if LEAVES[name] is int else -0.5)


@pytest.mark.parametrize("name", sorted(AT_LEAST_ONE | POSITIVE))
def test_a_zero_is_refused_where_it_means_nothing(name: str) -> None:
    refusal(name, 0 if LEAVES[name] is int else 0.0)


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_is_refused(name: str, value: float) -> None:
    refusal(name, value)


@pytest.mark.parametrize("name", sorted(AT_MOST_ONE))
def test_a_share_above_one_is_refused(name: str) -> None:
    refusal(name, 1.01)


@pytest.mark.parametrize("name", LEAVES)
def test_a_value_of_the_wrong_type_is_refused(name: str) -> None:
    kind = LEAVES[name]
    wrong: list[Any] = [None, [1], {"a": 1}]
    if kind is not bool:
        wrong.append(True)
    if kind is not str:
        wrong.append("many")
    if kind is not float:
        wrong.append(1.5)
    if kind in (bool, str):
        wrong.append(1)
    for value in wrong:
        refusal(name, value)


@pytest.mark.parametrize("name", FLOATS)
def test_a_whole_number_passes_for_a_float(name: str) -> None:
    accepted = config_module.from_dict(with_value(name, 1))
    for part in name.split("."):
        accepted = getattr(accepted, part)
    assert accepted == 1.0
    assert type(accepted) is float


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("env.num_beams", 1),
        ("env.field_of_view_deg", 360.0),
        ("env.ray_sectors", 2),
        ("env.ray_sectors", 34),
        ("env.heading_encoding", "degrees"),
        ("env.goal_distance_encoding", "logarithmic"),
        ("network.cell", "lstm"),
        ("env.velocity_noise_unit", "percent"),
        ("learner.learning_rate_schedule", "cosine"),
        ("algo", "ppo"),
        ("method", "sarsa"),
        ("seed", 2**31),
    ],
)
def test_other_values_out_of_range_are_refused(name: str, value: Any) -> None:
    refusal(name, value)


@pytest.mark.parametrize(
    "make",
    [
        lambda: EnvConfig(heading_encoding="degrees"),
        lambda: EnvConfig(velocity_noise_unit="percent"),
        lambda: EnvConfig(range_noise_unit="percent"),
        lambda: LearnerConfig(learning_rate_schedule="cosine"),
        lambda: TrainConfig(algo="ppo"),
        lambda: TrainConfig(method="sarsa"),
    ],
)
def test_an_unknown_word_is_refused_without_a_file_too(make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match="expected one of"):
        make()


@pytest.mark.parametrize("name", CHOICES)
def test_the_refusal_of_a_choice_lists_what_there_is(name: str) -> None:
    message = refusal(name, "nonsense")
    for option in typing.get_args(LEAVES[name]):
        assert option in message


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"num_envs": 30}, "replay.capacity"),
        ({"num_envs": 50, "total_episodes": 49}, "total_episodes"),
        ({"replay": {"capacity": 100, "min_episodes": 101}}, "replay.min_episodes"),
        ({"method": "pqn", "num_envs": 50, "learner": {"batch_size": 20}}, "learner.batch_size"),
        ({"method": "pqn", "num_envs": 50, "learner": {"batch_size": 100}}, "learner.batch_size"),
        ({"network": {"gate": "reachable", "num_skills": 3}}, "network.num_skills"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(changes: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} is .*, expected .*\Z"):
        config_module.from_dict(changes)


def test_pqn_does_not_ask_for_a_replay_that_fits() -> None:
    changes = {"method": "pqn", "num_envs": 30, "learner": {"batch_size": 10}}
    assert config_module.from_dict(changes).num_envs == 30


@pytest.mark.parametrize(
    ("data", "name"),
    [
        ({"speed": 1}, "speed"),
        ({"env": {"speed": 1}}, "env.speed"),
        ({"env": {"__class__": 1}}, "env.__class__"),
        ({"num_rounds": 3}, "num_rounds"),
        ({"env": 3}, "env"),
        ([1], "config"),
        (None, "config"),
    ],
)
def test_unknown_fields_and_misplaced_values_are_refused(data: Any, name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} is .*, expected .*\Z"):
        config_module.from_dict(data)


def changed_everywhere() -> TrainConfig:
    """A config in which no field has its default."""
    config = TrainConfig(
        algo="dqn",
        method="pqn",
        map="somewhere/else.yaml",
        task_sampling="learnability",
        start_from="pretrained:sqn",
        seed=7,
        num_seeds=2,
        total_episodes=90,
        num_envs=30,
        updates_per_round=3,
        rounds_per_chunk=4,
        checkpoint_minutes=1.5,
        checkpoint_replay=False,
        max_skipped_updates=2,
        env=EnvConfig(
            **{
                field.name: field.default * 1.5 + 0.01
                for field in dataclasses.fields(EnvConfig)
                if type(field.default) is float and field.name != "field_of_view_deg"
            },
            num_beams=31,
            field_of_view_deg=180.0,
            max_steps=77,
            ray_sectors=24,
            ray_iterations=3,
            heading_encoding="sincos",
            goal_distance_encoding="rational",
            velocity_noise_unit="absolute",
            range_noise_unit="absolute",
        ),
        randomization=config_module.RandomizationConfig(0.1, 0.2, 0.3, True),
        network=config_module.NetworkConfig(
            9, 3, True, 2, True, "refined_gru", "equal", 2.0, 0.1, False, 4
        ),
        replay=ReplayConfig(60, 30, False, 0.5, 0.25, 0.75),
        learner=LearnerConfig(
            10,
            1e-3,
            "linear",
            1e-8,
            2.5,
            0.9,
            0.8,
            False,
            3,
            False,
            4,
            0.5,
            0.125,
            0.2,
            11,
            2,
            True,
            0.25,
            "each",
            0.75,
        ),
        exploration=config_module.ExplorationConfig(0.9, 0.3, 0.5, True),
        eval=config_module.EvalConfig(12, 34, 5, 6),
    )
    return config


def test_a_config_comes_back_from_its_file_unchanged(tmp_path: Path) -> None:
    changed = changed_everywhere()
    default, other = config_module.to_dict(TrainConfig()), config_module.to_dict(changed)
    for name in LEAVES:
        old, new = default, other
        for part in name.split("."):
            old, new = old[part], new[part]
        assert old != new, f"{name} is not tried"
    for number, config in enumerate([*PRESETS.values(), changed]):
        path = tmp_path / f"{number}.json"
        config_module.save(config, path)
        assert config_module.load(path) == config
        assert hash(config_module.load(path)) == hash(config)
        assert json.loads(path.read_text())["env"]["num_beams"] == config.env.num_beams


def test_fields_left_out_take_their_defaults() -> None:
    assert config_module.from_dict({}) == TrainConfig()
    expected = TrainConfig(learner=LearnerConfig(n_step=3))
    assert config_module.from_dict({"learner": {"n_step": 3}}) == expected


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "no such file"),
        (b"{", "not valid JSON"),
        (b"", "not valid JSON"),
        (b'{"seed": -1}', "seed is -1"),
        (b'{"learner": {"discount": NaN}}', "NaN is no number"),
        (b"[]", "config is"),
    ],
)
def test_an_unusable_file_is_named_with_its_fault_in_one_line(
    tmp_path: Path, content: bytes | None, expected: str
) -> None:
    path = tmp_path / "config.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=expected) as caught:
        config_module.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_config_cannot_be_changed_in_place() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        TrainConfig().seed = 3  # type: ignore[misc]


def test_the_paper_preset_holds_the_values_of_the_paper() -> None:
    paper = PRESETS["paper"]
    # Section IV-C.
    assert (paper.algo, paper.method, paper.map) == ("sqn", "r2d2", "maze")
    assert paper.learner.batch_size == 64
    assert paper.network.hidden_size == 128
    assert paper.network.num_skills == 2
    assert paper.learner.target_update_rate == 0.002
    assert paper.exploration.epsilon_start == 0.4
    assert paper.exploration.epsilon_end == 0.1
    assert paper.exploration.decay_fraction == 1.0
    assert not paper.exploration.ladder
    assert paper.learner.burn_in_length == 10
    assert paper.total_episodes == 10_000
    # The layers after the features of DQN are three times as wide (IV-D); no layer norm anywhere.
    assert paper.network.dqn_width_factor == 3
    assert not paper.network.layer_norm
    # The robot and its senses: 71 beams 5 degrees apart over 350 degrees, 5 m (III-A, IV-A).
    env = paper.env
    assert (env.num_beams, env.field_of_view_deg, env.max_range) == (71, 350.0, 5.0)
    assert env.field_of_view_deg / (env.num_beams - 1) == 5.0
    assert (env.forward_speed, env.backward_speed, env.turn_rate) == (2.5, 1.25, math.pi)
    assert env.time_step == 0.1
    assert env.velocity_noise == env.range_noise == env.near_goal_fraction == 0.0
    # The reward (eq. 9).
    assert (env.reward_navigation, env.reward_exploration, env.reward_time) == (2.0, 1.0, 0.2)
    assert env.reward_collision == 0.0
    # One update a finished episode, sequences of the map's own length, R2D2 with all its parts.
    assert paper.updates_per_round == paper.num_envs
    assert env.max_steps == 0
    assert paper.learner.double_q
    assert paper.learner.value_rescaling
    assert paper.replay.prioritized
    assert (paper.learner.discount, paper.learner.n_step) == (0.997, 5)
    assert paper.learner.discount_start == 0
    assert (paper.replay.priority_exponent, paper.replay.importance_exponent) == (0.9, 0.6)
    assert paper.replay.max_priority_weight == 0.9


def test_quick_keeps_the_robot_the_reward_and_the_network_of_the_paper() -> None:
    """Only which tasks it trains on may differ."""
    quick, paper = PRESETS["quick"], PRESETS["paper"]
    assert dataclasses.replace(quick.env, near_goal_fraction=0.0) == paper.env
    assert quick.algo == paper.algo
    assert dataclasses.replace(quick.network, layer_norm=False) == paper.network


def test_the_run_is_divided_into_rounds_and_chunks_as_counted_by_hand() -> None:
    assert (PRESETS["paper"].num_rounds, PRESETS["paper"].num_chunks) == (200, 200)
    base = TrainConfig(num_envs=50, total_episodes=100, rounds_per_chunk=2)
    assert (base.num_rounds, base.num_chunks) == (2, 1)
    # 101 episodes need a third round, which needs a second chunk, which has a fourth.
    more = dataclasses.replace(base, total_episodes=101)
    assert (more.num_rounds, more.num_chunks) == (4, 2)
    single = dataclasses.replace(base, total_episodes=50, rounds_per_chunk=1)
    assert (single.num_rounds, single.num_chunks) == (1, 1)
