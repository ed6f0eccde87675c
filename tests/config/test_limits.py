"""What settings accept can be computed with: nothing is refused only after a run was trained."""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from test_config import FLOATS, INTEGERS, NUMBERS, POSITIVE, with_value

from sqn_jax import config as configs
from sqn_jax.cli import main
from sqn_jax.config.validation import LIMITS
from sqn_jax.evaluation.settings import Settings
from sqn_jax.runs.final_evaluation import settings_of

EXTREMES = (0, -1, 1, 100_001, 2**31 - 1, 2**31, 2**63, 10**18)
EXTREME_FLOATS = (0.0, -1.0, 1e-300, 1e-8, 1e6, 2e6, 2.0**63, 1e308, math.nan, math.inf)


def accepted(name: str, value: Any) -> Any:
    """The settings with one other value; None where they are refused, in one line that names it."""
    try:
        return configs.from_dict(with_value(name, value))
    except ValueError as error:
        message = str(error)
    assert "\n" not in message
    assert ", expected " in message
    return None


@pytest.mark.parametrize("name", NUMBERS)
def test_what_a_run_accepts_its_evaluation_accepts_and_the_device_can_hold(name: str) -> None:
    for value in EXTREMES if name in INTEGERS else EXTREME_FLOATS:
        config = accepted(name, value)
        if config is None:
            continue
        settings_of(config)
        with np.errstate(over="ignore"):
            single = np.float32(value)
        assert np.isfinite(single)
        assert abs(value) < 2**31 or name in FLOATS
        assert single > 0 or name not in POSITIVE
        assert config.num_rounds * config.num_envs <= 10**9


@pytest.mark.parametrize(
    ("of_run", "of_evaluation"),
    [
        ("eval.episodes", "episodes"),
        ("eval.seed", "seed"),
        ("env.max_steps", "max_steps"),
        ("env.velocity_noise", "noise"),
        ("env.goal_radius", "goal_radii"),
    ],
)
def test_a_run_and_an_evaluation_have_the_same_limits(of_run: str, of_evaluation: str) -> None:
    _, most = LIMITS[of_run]
    for value, is_accepted in ((most, True), (most + 1, False)):
        assert (accepted(of_run, value) is not None) == is_accepted
        given: Any = {"noise": ((float(value), 0.0),), "goal_radii": (float(value),)}
        changes: Any = {of_evaluation: given.get(of_evaluation, value)}
        with nullcontext() if is_accepted else pytest.raises(ValueError, match="expected"):
            Settings(maps=("maze",), eval_seeds=1, **changes)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--rounds-per-chunk", "3000000000"],
        ["--rounds-per-chunk", "900000000"],
        ["--num-seeds", "10", "--seed", "2147483640"],
        ["--eval.episodes", "200000"],
        ["--learner.n-step", "100000"],
    ],
)
def test_what_overflows_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    assert main(["train", *arguments]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert arguments[0].strip("-").replace("-", "_") in message.replace("-", "_")
