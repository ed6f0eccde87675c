"""Whether an exported folder is whole, and both ways to run it do what the policy did."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from flax import traverse_util
from numpy.typing import NDArray

from sqn_jax import config as configs
from sqn_jax.config import TrainConfig
from sqn_jax.export import sqn_policy
from sqn_jax.export.description import (
    describe_robot,
    observation_size,
    require_exportable,
    state_size,
)
from sqn_jax.export.folder import (
    CONFIG,
    FILES,
    ONNX,
    PARAMS,
    REFERENCE,
    RUNTIME,
    SUMS,
    onnx_description,
    require_libraries,
    runtime_source,
)
from sqn_jax.export.rollout import NUM_STEPS
from sqn_jax.export.safetensors_file import from_safetensors
from sqn_jax.outside.messages import named, one_line
from sqn_jax.outside.reading import parse_json, read_at_most
from sqn_jax.storage.arrays import read_arrays, read_headers
from sqn_jax.training.state import params_shapes

TOLERANCE = 1e-4
"""Largest difference of a Q-value, relative to the largest of its step."""

MAX_FILE_BYTES = 2**30

Step = Callable[[NDArray[np.float32], NDArray[np.float32]], tuple[NDArray[Any], NDArray[Any]]]
"""Of an observation and a hidden state, both [N]: Q-values [A] and the next hidden state."""


@dataclass(frozen=True)
class Agreement:
    """How what one runtime says of the reference rollout compares with what was recorded."""

    runtime: str
    q_difference: float
    """Largest difference of a Q-value, relative to the largest of its step."""
    other_actions: int
    """Steps with another action; all of them ties."""
    steps: int
    microseconds: float
    """Median time of a step."""


def check_export(folder: Path) -> list[Agreement]:
    """Compare digests, descriptions and what ONNX Runtime and NumPy compute with the reference.

    Nothing of the folder is executed but the graph: `sqn_policy.py` must be the one that comes with
    this version.

    Raises:
        ValueError: one line naming the file that is missing, changed, of another robot, or that
            computes something else.
    """
    require_libraries("onnx", "onnxruntime")
    contents = _read_whole(folder)
    if contents[RUNTIME] != runtime_source():
        raise ValueError(
            f"{named(folder / RUNTIME)}: is not that of this version of sqn_jax, expected an "
            "export of this version"
        )
    config, description = _described(folder, contents[CONFIG])
    _require_params(folder, contents[PARAMS], config)
    if hashlib.sha256(contents[PARAMS]).hexdigest() != description["params_sha256"]:
        raise ValueError(
            f"{named(folder / PARAMS)}: is of another policy: its digest is not params_sha256 "
            f"({CONFIG})"
        )
    _require_graph(folder / ONNX, contents[ONNX], onnx_description(description))
    reference = _reference(folder, contents[REFERENCE], config)
    numpy_policy = sqn_policy.Policy(folder / PARAMS)

    def by_numpy(obs: NDArray[np.float32], hidden: NDArray[np.float32]) -> Any:
        q_values, _, hidden = numpy_policy.step(obs, hidden)
        return q_values, hidden

    steps = {"ONNX Runtime": _onnx_step(contents[ONNX]), "NumPy": by_numpy}
    return [compare(name, step, reference) for name, step in steps.items()]


def _read_whole(folder: Path) -> dict[str, bytes]:
    """The files of an export, whose digests are those that it lists."""
    if not folder.is_dir():
        raise ValueError(f"{named(folder)}: no such folder, expected an export (sqn export --out)")
    listed = read_at_most(folder / SUMS, 2**12, "the digests of an export", follow=False)
    lines = [line.split("  ") for line in listed.decode("utf-8", "replace").splitlines()]
    digests = {line[-1]: line[0] for line in lines if len(line) == 2}
    if sorted(digests) != sorted(FILES) or len(lines) != len(FILES):
        raise ValueError(f"{named(folder / SUMS)}: expected the digests of {', '.join(FILES)}")
    contents = {}
    for name in FILES:
        data = read_at_most(folder / name, MAX_FILE_BYTES, "a file of an export", follow=False)
        if hashlib.sha256(data).hexdigest() != digests[name]:
            raise ValueError(f"{named(folder / name)}: has changed since it was exported ({SUMS})")
        contents[name] = data
    return contents


def _described(folder: Path, data: bytes) -> tuple[TrainConfig, dict[str, Any]]:
    """The settings in config.json, whose description of the robot is what they say."""
    path = folder / CONFIG
    try:
        description = parse_json(data)
        keys = {"name", "versions", "robot", "config", "params_sha256"}
        if not isinstance(description, dict) or description.keys() != keys:
            raise ValueError(f"expected {', '.join(sorted(keys))}")
        config: TrainConfig = configs.from_dict(description["config"])
        require_exportable(config)
        difference = _first_difference(description["robot"], describe_robot(config))
    except ValueError as error:
        raise ValueError(f"{named(path)}: {one_line(error)}") from None
    if difference:
        raise ValueError(f"{named(path)}: robot: {difference} by its own settings")
    return config, description


def _require_params(folder: Path, data: bytes, config: TrainConfig) -> None:
    shapes = traverse_util.flatten_dict(params_shapes(config), sep="/")
    try:
        arrays = from_safetensors(data, {path: leaf.shape for path, leaf in shapes.items()})
    except ValueError as error:
        raise ValueError(f"{named(folder / PARAMS)}: {error}") from None
    for path, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{named(folder / PARAMS)}: array {path} holds numbers not finite")


def _first_difference(found: Mapping[str, Any], expected: Mapping[str, Any]) -> str:
    """The first key of which two descriptions say something else, and what; or nothing."""
    if not isinstance(found, dict):
        return "is no object, expected one"
    for name in sorted(found.keys() | expected.keys()):
        if found.get(name) != expected.get(name):
            texts = [repr(side.get(name))[:80] for side in (found, expected)]
            return f"{name} is {texts[0]}, expected {texts[1]}"
    return ""


def _require_graph(path: Path, data: bytes, description: Mapping[str, Any]) -> None:
    """Refuse what is no sound graph, or one of another robot than config.json describes."""
    import onnx

    try:
        model = onnx.load_model_from_string(data)
        onnx.checker.check_model(model, full_check=True)
        found = {
            entry.key: parse_json(entry.value.encode())
            if not isinstance(description.get(entry.key), str)
            else entry.value
            for entry in model.metadata_props
        }
    except Exception as error:  # protobuf and onnx raise many kinds on damaged files.
        raise ValueError(f"{named(path)}: no sound ONNX file ({one_line(error)[:200]})") from None
    if difference := _first_difference(found, description):
        raise ValueError(f"{named(path)}: is of another robot or policy: {difference} ({CONFIG})")


def _reference(folder: Path, data: bytes, config: TrainConfig) -> dict[str, NDArray[Any]]:
    """The arrays of reference.npz, of the shapes that the policy's have."""
    actions, skills = 5, config.network.num_skills if config.algo == "sqn" else 1
    expected = {
        "observations": ((NUM_STEPS, observation_size(config)), "f"),
        "hidden": ((NUM_STEPS + 1, state_size(config)), "f"),
        "q_values": ((NUM_STEPS, actions), "f"),
        "skill_weights": ((NUM_STEPS, skills), "f"),
        "actions": ((NUM_STEPS,), "i"),
    }
    try:
        headers = read_headers(data)
        found = {name: (shape, dtype.kind) for name, (shape, dtype, _) in headers.items()}
        if found != expected:
            raise ValueError(f"expected {', '.join(expected)} of {NUM_STEPS} steps of this robot")
        return read_arrays(data, headers)
    except ValueError as error:
        raise ValueError(f"{named(folder / REFERENCE)}: {one_line(error)}") from None


def _onnx_step(data: bytes) -> Step:
    """One step by ONNX Runtime on one core."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def step(obs: NDArray[np.float32], hidden: NDArray[np.float32]) -> Any:
        inputs = {"obs": obs[None], "h_in": hidden[None, None]}
        q_values, hidden = session.run(["q_values", "h_out"], inputs)
        return q_values[0], hidden[0, 0]

    return step


def compare(runtime: str, step: Step, reference: Mapping[str, NDArray[Any]]) -> Agreement:
    """Run the observations of a rollout with hidden states of one's own.

    Raises:
        ValueError: a Q-value is too far off, or another action is no tie.
    """
    hidden = reference["hidden"][0]
    differences, ties, seconds = [], 0, []
    for index, obs in enumerate(reference["observations"]):
        before = time.perf_counter()
        q_values, hidden = step(obs, hidden)
        seconds.append(time.perf_counter() - before)
        expected = reference["q_values"][index]
        scale = np.abs(expected).max()
        # Written so that what is not a number is no agreement.
        if not np.abs(q_values - expected).max() <= TOLERANCE * scale:
            raise ValueError(
                f"{runtime}: the Q-values of step {index} are {np.round(q_values, 4).tolist()}, "
                f"expected {np.round(expected, 4).tolist()} ({REFERENCE})"
            )
        chosen = int(reference["actions"][index])
        possible = 0 <= chosen < expected.size
        if not possible or expected.max() - expected[chosen] > 2 * TOLERANCE * scale:
            raise ValueError(
                f"{named(Path(REFERENCE))}: action {chosen} of step {index} has not the largest of "
                f"the Q-values {np.round(expected, 4).tolist()}"
            )
        differences.append(float(np.abs(q_values - expected).max() / max(scale, 1e-30)))
        ties += int(q_values.argmax() != reference["actions"][index])
    return Agreement(
        runtime, max(differences), ties, len(differences), float(np.median(seconds)) * 1e6
    )
