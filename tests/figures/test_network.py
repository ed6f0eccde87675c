"""The drawing of a network has all that is in the parameter tree, and in the right boxes."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawing import check_texts, drawn
from flax import traverse_util

from sqn_jax import figures
from sqn_jax.config import TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.training.state import params_shapes

QUICK = PRESETS["quick"]
NETWORKS = {
    "paper": PRESETS["paper"],
    "four skills, layer norm": replace(QUICK, network=replace(QUICK.network, num_skills=4)),
    "R2D2": replace(QUICK, algo="r2d2"),
    "DQN": replace(QUICK, algo="dqn"),
    "last motion": replace(QUICK, network=replace(QUICK.network, motion_inputs=True)),
    "equal weights": replace(QUICK, network=replace(QUICK.network, gate="equal")),
    "balanced": replace(QUICK, network=replace(QUICK.network, gate_balance_rate=0.1)),
    "no embeddings": replace(QUICK, network=replace(QUICK.network, embeddings=False)),
}


def texts_of(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.axes[0].texts]


def numbers_after(pattern: str, texts: list[str]) -> list[int]:
    matches = [re.search(pattern, text) for text in texts]
    return [int(match[1].replace(",", "")) for match in matches if match]


@pytest.mark.parametrize("config", NETWORKS.values(), ids=NETWORKS)
def test_every_leaf_of_the_parameter_tree_is_drawn(config: TrainConfig) -> None:
    params = params_shapes(config)
    figure = drawn(figures.network_architecture(params, title="network"))
    texts = texts_of(figure)
    leaves = traverse_util.flatten_dict(params["params"], sep="/")
    # The parameters that the boxes and embeddings count are those of all leaves.
    total = sum(int(np.prod(leaf.shape)) for leaf in leaves.values())
    counted = numbers_after(r"^([\d,]+) parameters$", texts)
    counted += numbers_after(r"^embedding\n(\d+)$", texts)
    assert sum(counted) == total
    assert f"{total:,} parameters" in figure._suptitle.get_text()
    # Each matrix has a row, as often as the tree has it.
    for leaf in leaves.values():
        if len(leaf.shape) == 2:
            same = sum(other.shape == leaf.shape for other in leaves.values())
            row = " → ".join(map(str, leaf.shape))
            assert sum(text.endswith(row) for text in texts) == same
    check_texts(figure)


def test_another_layer_has_a_row_in_the_box_of_its_module() -> None:
    def layer(*shape: int) -> dict[str, Any]:
        return {"kernel": np.zeros(shape), "bias": np.zeros(shape[1])}

    features = {"ranges": {"one": layer(7, 3)}, "goal": {"one": layer(2, 4)}}
    head = {"first": layer(6, 11), "second": layer(11, 13), "output": layer(13, 5)}
    params = {"features": features, "perception": layer(7, 6), "skill_0": head}
    texts = texts_of(figures.network_architecture({"params": params}, title="network"))
    start = texts.index("Q-head")
    rows = ["first 6 → 11", "second 11 → 13", "output 13 → 5", "303 parameters"]
    assert texts[start + 1 : start + 5] == rows


def test_a_module_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="the network has attention, expected"):
        figures.network_architecture({"params": {"attention": {}}}, title="network")
