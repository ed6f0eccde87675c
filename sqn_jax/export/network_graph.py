"""A trained policy as an ONNX graph, written node by node: observation in SI units to a command.

Converters trip over recurrent cells and would leave the scaling of the observation to the user.
Each array of the policy becomes one initializer of the same name; one that no node takes is an
error, so that a network with other parts is refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from sqn_jax.config import EnvConfig, NetworkConfig, TrainConfig
from sqn_jax.env.navigation import BACKWARD, FORWARD
from sqn_jax.env.prepare import commands_of
from sqn_jax.export.description import observation_size, state_size

OPSET = 17
IR_VERSION = 8
"""That of the time of opset 17: newer ones are refused by older runtimes."""

LAYER_NORM_EPSILON = 1e-6
"""That of `flax.linen.LayerNorm`."""

Arrays = Mapping[str, NDArray[np.float32]]


class _Graph:
    """The nodes so far; values go by their names."""

    def __init__(self, arrays: Arrays) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self._unused = dict(arrays)

    def node(self, operator: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """Add a node with one output, whose name is returned."""
        name = output or f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [name], name, **attributes))
        return name

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """Add numbers that are no parameters."""
        name = f"constant_{len(self.initializers)}"
        self.initializers.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def parameter(self, path: str) -> str:
        """Take an array of the policy, which is then used up."""
        if path not in self._unused:
            raise ValueError(f"array {path} is missing or used twice, expected it once")
        array = np.ascontiguousarray(self._unused.pop(path))
        self.initializers.append(numpy_helper.from_array(array, path))
        return path

    def has(self, path: str) -> bool:
        """Whether there is such an array that was not used yet."""
        return path in self._unused

    def require_all_used(self) -> None:
        """Refuse arrays of which the graph makes nothing."""
        if self._unused:
            raise ValueError(
                f"array {min(self._unused)} belongs to a part of the network that cannot be "
                "exported"
            )


def policy_graph(
    config: TrainConfig, arrays: Arrays, description: Mapping[str, Any]
) -> onnx.ModelProto:
    """The graph of a policy.

    Inputs: `obs` [1, R + 2]: R ranges in m from right to left, the goal's distance in m and its
    heading in rad; `h_in` [1, 1, H], zeros at the start and at each new goal. With
    `network.motion_inputs` `obs` has one column more, 1 where the last command was a move and the
    robot did not move, else 0; and the last action, one-hot, follows the H numbers of `h_in`.
    Outputs: `actions` [1, 2] m/s and rad/s, `action_index` [1], `q_values` [1, A], `skill_weights`
    [1, K], `h_out` as `h_in`.

    Args:
        config: of the policy; `require_exportable` must hold.
        arrays: its parameters by their paths, "params/features/ranges/hidden/kernel" for one.
        description: what stands in `metadata_props`: texts as they are, all else as JSON.

    Raises:
        ValueError: an array is missing, or belongs to no part that is known here.
    """
    env, network = config.env, config.network
    graph = _Graph(arrays)
    size, num_actions = network.hidden_size, len(commands_of(env))
    memory = graph.node("Reshape", "h_in", graph.constant([1, -1], np.int64))
    carry = _columns(graph, memory, 0, size)
    motion = _motion(graph, memory, config) if network.motion_inputs else []
    features = _features(graph, *_observation(graph, env), motion)
    carry, perception = _perception(graph, config.algo, features, carry)
    skill_weights, q_values = _heads(graph, config.algo, network, perception)
    graph.node("Identity", skill_weights, output="skill_weights")
    graph.node("Identity", q_values, output="q_values")
    graph.node("ArgMax", "q_values", output="action_index", axis=1, keepdims=0)
    if network.motion_inputs:
        one_hot = graph.constant(np.eye(num_actions))
        carry = graph.node(
            "Concat", carry, graph.node("Gather", one_hot, "action_index", axis=0), axis=1
        )
    after = graph.node("Reshape", carry, graph.constant([1, 1, -1], np.int64))
    # A goal that is unknown for once must not erase what the policy has seen.
    unknown = graph.node("IsNaN", _columns(graph, "q_values", 0, 1))
    graph.node("Where", unknown, "h_in", after, output="h_out")
    commands = graph.constant(commands_of(env))
    graph.node("Gather", commands, "action_index", output="actions", axis=0)
    graph.require_all_used()

    num_skills = network.num_skills if config.algo == "sqn" else 1
    hidden = ("float32", [1, 1, state_size(config)])
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "sqn_jax_policy",
            _values({"obs": ("float32", [1, observation_size(config)]), "h_in": hidden}),
            _values(
                {
                    "actions": ("float32", [1, 2]),
                    "action_index": ("int64", [1]),
                    "q_values": ("float32", [1, num_actions]),
                    "skill_weights": ("float32", [1, num_skills]),
                    "h_out": hidden,
                }
            ),
            graph.initializers,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="sqn_jax",
    )
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in description.items()
    }
    helper.set_model_props(model, texts)
    return model


def _values(shapes: Mapping[str, tuple[str, list[int]]]) -> list[onnx.ValueInfoProto]:
    types = {"float32": TensorProto.FLOAT, "int64": TensorProto.INT64}
    return [
        helper.make_tensor_value_info(name, types[dtype], shape)
        for name, (dtype, shape) in shapes.items()
    ]


def _observation(graph: _Graph, env: EnvConfig) -> tuple[str, str]:
    """The ranges [1, R] and the goal [1, G] as the network sees them, in 0..1: `env.observe`."""
    zero, one = graph.constant(0.0), graph.constant(1.0)
    readings = _columns(graph, "obs", 0, env.num_beams)
    far = graph.constant(env.max_range)
    is_nan = graph.node("IsNaN", readings)  # Infinity is clipped.
    seen = graph.node("Where", is_nan, far, readings)
    ranges = graph.node("Clip", graph.node("Div", seen, far), zero, one)
    distance = _columns(graph, "obs", env.num_beams, env.num_beams + 1)
    if env.goal_distance_encoding == "clipped":
        scaled = graph.node("Div", distance, graph.constant(env.max_goal_distance))
        parts = [graph.node("Clip", scaled, zero, one)]
    else:
        # d / (d + c), written so that an infinite distance is 1 and not NaN.
        scale = graph.constant(env.goal_distance_scale)
        nearness = graph.node("Div", scale, graph.node("Add", distance, scale))
        parts = [graph.node("Sub", one, nearness)]
    heading = _columns(graph, "obs", env.num_beams + 1, env.num_beams + 2)
    if env.heading_encoding == "linear":
        parts.append(_turns(graph, heading))
    else:
        half = graph.constant(0.5)
        for function in ("Sin", "Cos"):
            shifted = graph.node("Add", graph.node(function, heading), one)
            parts.append(graph.node("Mul", shifted, half))
    return ranges, graph.node("Concat", *parts, axis=1)


def _columns(graph: _Graph, value: str, first: int, last: int) -> str:
    """Columns `first` to `last` - 1 of [1, N]."""
    ends = [graph.constant([number], np.int64) for number in (first, last, 1)]
    return graph.node("Slice", value, *ends)


def _motion(graph: _Graph, memory: str, config: TrainConfig) -> list[str]:
    """The last action [1, A], and whether it was a move that was refused [1, 1]."""
    size, beams = config.network.hidden_size, config.env.num_beams
    last = _columns(graph, memory, size, state_size(config))
    moves = [
        _columns(graph, memory, size + action, size + action + 1) for action in (FORWARD, BACKWARD)
    ]
    refused = _columns(graph, "obs", beams + 2, beams + 3)
    return [last, graph.node("Mul", refused, graph.node("Add", *moves))]


def _turns(graph: _Graph, heading: str) -> str:
    """(heading + pi) / 2 pi; folded into 0..1 where it lies outside, and only there.

    At the back single precision would else put 0 in the place of 1.
    """
    half = graph.constant(0.5)
    shifted = graph.node("Add", heading, graph.constant(math.pi))
    turns = graph.node("Div", shifted, graph.constant(2 * math.pi))
    folded = graph.node("Sub", turns, graph.node("Floor", turns))
    away = graph.node("Abs", graph.node("Sub", turns, half))
    return graph.node("Where", graph.node("Greater", away, half), folded, turns)


def _features(graph: _Graph, ranges: str, goal: str, motion: list[str]) -> str:
    """Paper eq. 1, [1, 2 H], and what the robot knows of its last step."""
    both = [
        _mlp(graph, f"params/features/{name}", value)
        for name, value in (("ranges", ranges), ("goal", goal))
    ]
    return graph.node("Concat", *both, *motion, axis=1)


def _perception(graph: _Graph, algo: str, features: str, carry: str) -> tuple[str, str]:
    """The next carry [1, H], and what the heads see: paper eq. 2, or a layer without memory."""
    if algo == "dqn":
        hidden = _linear(graph, "params/perception", features)
        return carry, graph.node("Relu", _normalized(graph, "params/norm", hidden))
    carry = _gru(graph, "params/perception", features, carry)
    return carry, carry


def _gru(graph: _Graph, path: str, inputs: str, carry: str) -> str:
    """The next hidden state [1, H] of a gated recurrent unit, as in `agent/gru.py`."""
    kernel = graph.parameter(f"{path}/input_kernel")
    projected = graph.node("MatMul", inputs, kernel)
    projected = graph.node("Add", projected, graph.parameter(f"{path}/input_bias"))
    recurrent = graph.node("MatMul", carry, graph.parameter(f"{path}/hidden_kernel"))
    to_reset, to_update, to_candidate = _thirds(graph, projected)
    from_reset, from_update, inner = _thirds(graph, recurrent)
    reset = graph.node("Sigmoid", graph.node("Add", to_reset, from_reset))
    update = graph.node("Sigmoid", graph.node("Add", to_update, from_update))
    inner = graph.node("Add", inner, graph.parameter(f"{path}/candidate_bias"))
    inner = graph.node("Mul", reset, inner)
    candidate = graph.node("Tanh", graph.node("Add", to_candidate, inner))
    difference = graph.node("Sub", carry, candidate)
    return graph.node("Add", candidate, graph.node("Mul", update, difference))


def _thirds(graph: _Graph, value: str) -> list[str]:
    """The three gates of [1, 3 H]."""
    names = [f"{value}_{gate}" for gate in ("r", "z", "n")]
    graph.nodes.append(helper.make_node("Split", [value], names, f"{value}_gates", axis=1))
    return names


def _heads(graph: _Graph, algo: str, network: NetworkConfig, perception: str) -> tuple[str, str]:
    """The skill weights [1, K] and the Q-values [1, A]: paper eq. 3 to 6, or a single head."""
    if algo != "sqn":
        return graph.constant([[1.0]]), _mlp(graph, "params/skill_0", perception)
    logits = _embedded_mlp(graph, "decision", perception)
    weights = graph.node("Softmax", logits, axis=1)
    names = [f"skill_{index}" for index in range(network.num_skills)]
    values = [_embedded_mlp(graph, name, perception) for name in names]
    stacked = graph.node("Concat", *values, axis=0)
    return weights, graph.node("MatMul", weights, stacked)


def _embedded_mlp(graph: _Graph, name: str, perception: str) -> str:
    """A module of the SQN, which sees the perception shifted by its embedding."""
    embedding = graph.parameter(f"params/{name}_embedding")
    return _mlp(graph, f"params/{name}", graph.node("Add", perception, embedding))


def _mlp(graph: _Graph, path: str, inputs: str) -> str:
    """Two linear layers with a ReLU in between, layer-normalized before it where it was so."""
    hidden = _normalized(graph, f"{path}/norm", _linear(graph, f"{path}/hidden", inputs))
    return _linear(graph, f"{path}/output", graph.node("Relu", hidden))


def _normalized(graph: _Graph, path: str, inputs: str) -> str:
    """Layer normalization, where the policy has parameters for it."""
    if not graph.has(f"{path}/scale"):
        return inputs
    return graph.node(
        "LayerNormalization",
        inputs,
        graph.parameter(f"{path}/scale"),
        graph.parameter(f"{path}/bias"),
        epsilon=LAYER_NORM_EPSILON,
    )


def _linear(graph: _Graph, path: str, inputs: str) -> str:
    product = graph.node("MatMul", inputs, graph.parameter(f"{path}/kernel"))
    return graph.node("Add", product, graph.parameter(f"{path}/bias"))
