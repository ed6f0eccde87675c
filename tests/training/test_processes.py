"""What several processes of a run agree on; the others are made up here, and no process is started.

Whole runs in several processes are in tests/runs/test_several_processes.py.
"""

from __future__ import annotations

import argparse
import errno
import json
import socket
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from refusals import refusal

from sqn_jax.cli.processes import OPTIONS, cluster_of
from sqn_jax.config import LearnerConfig, TrainConfig
from sqn_jax.training import devices, processes
from sqn_jax.training.processes import Cluster, OtherFailed, ProcessLost

AT_HOME = {"coordinator": "node1:1234", "num_processes": 3, "process_id": 1}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"coordinator": "node1"}, "--coordinator is 'node1', expected HOST:PORT of process 0"),
        ({"coordinator": ":1234"}, "--coordinator is ':1234', expected HOST:PORT"),
        ({"coordinator": "node1:70000"}, "--coordinator is 'node1:70000', expected HOST:PORT"),
        ({"num_processes": 0}, "--num-processes is 0, expected 1 or more"),
        ({"process_id": 3}, "--process-id is 3, expected 0 to 2"),
        ({"process_id": -1}, "--process-id is -1, expected 0 to 2"),
        ({"timeout": 0}, "--process-timeout is 0, expected 1 to 86400 seconds"),
    ],
)
def test_processes_that_make_no_sense_are_refused(changes: dict[str, Any], words: str) -> None:
    assert words in refusal(lambda: Cluster(**{**AT_HOME, **changes}))


def options(**given: Any) -> argparse.Namespace:
    return argparse.Namespace(**{**dict.fromkeys(OPTIONS), "run_dir": "shared", **given})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"coordinator": "node1:1234", "process_id": 0}, "--num-processes: missing"),
        ({"process_timeout": 9}, "--coordinator, --num-processes, --process-id: missing"),
        ({**AT_HOME, "distributed": "auto"}, "expected none of --coordinator"),
        ({**AT_HOME, "run_dir": None}, "--run-dir: missing, expected a folder that all"),
    ],
)
def test_options_that_do_not_go_together_are_refused(given: dict[str, Any], words: str) -> None:
    assert words in refusal(lambda: cluster_of(options(**given)))


def test_options_say_where_the_processes_find_each_other() -> None:
    assert cluster_of(options(run_dir=None)) is None
    assert cluster_of(options(**AT_HOME)) == Cluster("node1:1234", 3, 1, 300)
    assert cluster_of(options(distributed="auto", process_timeout=9)) == Cluster(timeout=9)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_port_that_is_in_use_is_refused_before_jax_crashes_on_it() -> None:
    with socket.create_server(("", 0)) as server:
        port = server.getsockname()[1]
        words = refusal(lambda: processes.join(Cluster(f"localhost:{port}", 2, 0)))
    assert f"--coordinator localhost:{port}: port {port} is in use here" in words


@pytest.fixture
def beside(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Makes this process the first of two, of which the other always has the same to say."""

    def other(value: Any) -> None:
        message = json.dumps(value).encode()

        def both(mine: Any) -> Any:
            if mine.dtype == np.uint8:
                return np.stack([mine, np.frombuffer(message.ljust(len(mine)), np.uint8)])
            return np.stack([mine, np.int32(len(message))])

        monkeypatch.setattr(processes.multihost_utils, "process_allgather", both)
        monkeypatch.setattr(jax, "process_count", lambda: 2)

    return other


@pytest.mark.parametrize("length", [0, 200, 253, 254, 255, 5_000])
def test_messages_of_any_length_reach_the_others_as_they_are(
    beside: Callable[[Any], None], length: int
) -> None:
    beside({"said": "é" * length})
    assert processes.gather([1, None, "ü"]) == [[1, None, "ü"], {"said": "é" * length}]


def test_processes_that_were_started_otherwise_are_refused(
    beside: Callable[[Any], None],
) -> None:
    beside({"seed": 0, "num_envs": 8})
    processes.require_same({"num_envs": 8, "seed": 0})
    words = refusal(lambda: processes.require_same({"num_envs": 4, "seed": 0}))
    assert words == "process 1: num_envs is 8, expected 4 as in process 0"
    words = refusal(lambda: processes.require_same({"num_envs": 8, "seed": 0, "new": 1}))
    assert words == "process 1: new is None, expected 1 as in process 0"


def test_what_fails_in_one_process_ends_the_others_in_its_words(
    beside: Callable[[Any], None],
) -> None:
    beside(None)
    with processes.together():
        pass
    mine = OSError(errno.ENOSPC, "full")
    with pytest.raises(OSError, match="full") as caught, processes.together():
        raise mine
    assert caught.value is mine
    beside({"message": "no such map", "is_input": True})
    with pytest.raises(ValueError, match=r"^process 1: no such map$"), processes.together():
        pass
    beside({"message": "disk full", "is_input": False})
    with pytest.raises(OtherFailed, match=r"^process 1: disk full$"), processes.together():
        pass


def test_a_lost_process_is_told_from_other_failures(beside: Callable[[Any], None]) -> None:
    closed = "Gloo all-reduce failed: [pair.cc:547] Connection closed by peer [127.0.0.1]:1947"
    assert not processes.has_lost(ValueError(f"UNKNOWN: {closed}"))  # There is no other.
    beside(None)
    for lost in (
        ValueError(f"UNKNOWN: {closed}"),
        jax.errors.JaxRuntimeError(f"UNKNOWN: {closed}"),
        jax.errors.JaxRuntimeError("DEADLINE_EXCEEDED: Barrier timed out"),
        ProcessLost(),
    ):
        assert processes.has_lost(lost)
    for other in (
        ValueError("connection is 3, expected 4"),
        OSError("Connection closed by peer"),
        jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory"),
    ):
        assert not processes.has_lost(other)


@pytest.mark.parametrize(("wanted", "words"), [(1, "2 to 2 of 2 processes, as many of each")])
def test_a_run_takes_as_many_devices_of_each_process(
    monkeypatch: pytest.MonkeyPatch, wanted: int, words: str
) -> None:
    every = jax.devices()
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "local_devices", lambda process: [every[process]])
    # By the size of a minibatch one device would do.
    config = TrainConfig(method="pqn", num_envs=8, learner=LearnerConfig(batch_size=4))
    mesh = devices.choose(config)
    assert mesh is not None
    assert list(mesh.devices.flat) == every
    message = refusal(lambda: devices.choose(config, wanted))
    assert message == f"--num-devices is {wanted}, expected {words}"


def test_processes_with_different_numbers_of_devices_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts = [4, 4, 3]
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    monkeypatch.setattr(jax, "local_devices", lambda process: [None] * counts[process])
    words = refusal(processes.require_as_many_devices)
    assert words == "process 2 has 3 devices, expected 4 as in process 0"
