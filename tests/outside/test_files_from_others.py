"""Files and arguments from somebody else: what cannot be used is refused in one line."""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from refusals import refusal
from rooms import small_room

from sqn_jax import reset, step
from sqn_jax.config import NetworkConfig, TrainConfig
from sqn_jax.config.files import to_dict
from sqn_jax.env import reset_to
from sqn_jax.outside.messages import say
from sqn_jax.outside.reading import parse_json, read_at_most
from sqn_jax.policies.pretrained import find_policy
from sqn_jax.storage.files import write_whole
from sqn_jax.storage.lock import locked
from sqn_jax.storage.metrics import to_text
from sqn_jax.storage.run_folder import RunFolder, require_usable
from sqn_jax.training.state import params_shapes


@pytest.mark.parametrize("name", ["a\\b", "[a]", "gs:", "a\nb", "\x1b[31m", "\u202e", "\udcff"])
def test_a_name_that_checkpoints_lose_or_a_terminal_obeys_is_refused(
    tmp_path: Path, name: str
) -> None:
    assert "its path holds" in refusal(lambda: RunFolder.create(tmp_path / name, TrainConfig()))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a b ", "-x", "a#b", "a%20b", "ä", "a:b", "x" * 255])
def test_other_names_are_used_and_a_folder_may_be_a_link(tmp_path: Path, name: str) -> None:
    RunFolder.create(tmp_path / name, TrainConfig())
    (tmp_path / "link").symlink_to(tmp_path / name)
    assert RunFolder.open(tmp_path / "link")[1] == TrainConfig()


def test_what_is_printed_cannot_control_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("a\x1b[2J\r\n\u202e\x9b\udcff\x00 ä", error=True)
    assert capsys.readouterr().err == "a\\x1b[2J\\r\\n\\u202e\\x9b\\udcff\\x00 ä\n"


@pytest.mark.parametrize("kind", ["link", "pipe", "folder", "device"])
@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl", ".lock", "checkpoints"])
def test_an_odd_file_of_a_run_is_refused_and_nothing_behind_it_touched(
    tmp_path: Path, kind: str, name: str
) -> None:
    target, path = tmp_path / "target", tmp_path / "run" / name
    target.write_text("precious")
    path.parent.mkdir()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        if name == "checkpoints":
            return
        path.mkdir()
    else:
        path.symlink_to(target if kind == "link" else "/dev/zero")
    assert name in refusal(lambda: require_usable(path.parent))
    if name == ".lock":
        with pytest.raises(ValueError, match="cannot be written"), locked(path.parent):
            pass
    assert target.read_text() == "precious"


def test_unfinished_files_are_never_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("precious")
    for name in (f".a.{os.getpid()}.partial.json", "a.json"):
        (tmp_path / name).symlink_to(tmp_path / "target")
    write_whole(tmp_path / "a.json", "new")
    assert (tmp_path / "a.json").read_text() == "new"
    assert (tmp_path / "target").read_text() == "precious"


@pytest.mark.parametrize(
    "text",
    [
        *("NaN", "[-Infinity]", "1e999", "9" * 5000, "9" * 25, '{"a": 1, "a": 2}', "[" * 100_000),
        *("\xff", "", "[" * 33 + "1" + "]" * 33),
    ],
)
def test_json_that_readers_disagree_on_is_refused(text: str) -> None:
    refusal(lambda: parse_json(text.encode("latin-1")))


def test_a_file_larger_than_expected_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**40)
    assert "larger than 10 bytes" in refusal(lambda: read_at_most(tmp_path / "large", 10, "text"))


ROWS = [{"chunk": n, "episodes": 4 * n, "loss": None, "usage": [0.5, 0.5]} for n in (1, 2, 3, 4)]
CONFIG = TrainConfig(num_envs=4, total_episodes=16, rounds_per_chunk=1)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda lines: lines.insert(2, lines[1]), 3),
        (lambda lines: lines.pop(1), 2),
        (lambda lines: lines.insert(0, lines.pop(2)), 1),
        (lambda lines: lines.append(lines[3]), 5),
        *(
            (lambda lines, old=old, new=new: lines.append(lines.pop().replace(old, new)), 4)
            for old, new in [(b"null", b"NaN"), (b"null", b"[1]"), (b"16", b"17"), (b"loss", b"x")]
        ),
        (lambda lines: lines.__setitem__(2, lines[2][:9] + b"\n"), 3),
        (lambda lines: lines.__setitem__(2, b"\x00\xff\n"), 3),
        (lambda lines: lines.__setitem__(2, b"[" * 2_000_000 + b"\n"), 3),
    ],
)
def test_an_edited_line_of_metrics_is_named(
    tmp_path: Path, change: Callable[[list[bytes]], Any], line: int
) -> None:
    lines = to_text(ROWS).encode().splitlines(keepends=True)
    change(lines)
    (tmp_path / "metrics.jsonl").write_bytes(b"".join(lines))
    folder = RunFolder(tmp_path)
    assert f"metrics.jsonl: line {line} " in refusal(folder.read_metrics)
    assert f"metrics.jsonl: line {line} " in refusal(lambda: folder.rows_of(line, CONFIG))


def test_a_row_cut_off_at_the_end_is_left_out_or_missed(tmp_path: Path) -> None:
    for tail in (to_text(ROWS[3:])[:-5].encode(), b"\0" * 100, b""):
        (tmp_path / "metrics.jsonl").write_bytes(to_text(ROWS[:3]).encode() + tail)
        assert RunFolder(tmp_path).read_metrics() == ROWS[:3]
        assert RunFolder(tmp_path).rows_of(3, CONFIG) == ROWS[:3]
        assert "line 4 is missing" in refusal(lambda: RunFolder(tmp_path).rows_of(4, CONFIG))


SMALL = TrainConfig(network=NetworkConfig(hidden_size=2))
BIAS = "params/decision/output/bias.npy"


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array))
    return buffer.getvalue()


def policy(folder: Path, changed: dict[str, bytes], network: dict[str, int] | None = None) -> str:
    """A policy's files with changed members and settings, and a checksum that fits."""
    leaves = jax.tree_util.tree_flatten_with_path(params_shapes(SMALL))[0]
    members = {
        jax.tree_util.keystr(path, simple=True, separator="/") + ".npy": npy(
            np.zeros(leaf.shape, np.float32)
        )
        for path, leaf in leaves
    }
    with zipfile.ZipFile(folder / "p.npz", "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in (members | changed).items():
            file.writestr(name, data)
    digest = hashlib.sha256((folder / "p.npz").read_bytes()).hexdigest()
    config = to_dict(SMALL)
    config["network"] |= network or {}
    (folder / "p.json").write_text(json.dumps({"config": config, "sha256": digest}))
    return str(folder / "p.npz")


def test_a_sound_policy_is_read(tmp_path: Path) -> None:
    assert find_policy(policy(tmp_path, {})).config == SMALL


@pytest.mark.parametrize(
    "changed",
    [
        {BIAS: npy(np.array([np.nan, 0], np.float32))},
        {BIAS: npy(np.zeros(2))},
        {BIAS: npy(np.array(["a", "b"]))},
        {BIAS: npy(np.zeros(2, np.float32))[:-1]},
        {BIAS: npy(np.zeros(2, np.float32)) + b"x"},
        {
            BIAS: npy(np.zeros(2, np.float32)).replace(
                b"(2,), }" + b" " * 20, b"(2" + b"0" * 20 + b",), }"
            )
        },
        {BIAS: npy(np.zeros(3_000_000, np.float32))},
        {BIAS: b""},
        {"extra.npy": npy(np.zeros(2, np.float32))},
        {"readme.txt": b"hello"},
    ],
)
def test_arrays_that_are_not_those_of_the_network_are_refused(
    tmp_path: Path, changed: dict[str, bytes]
) -> None:
    assert "policy p" in refusal(lambda: find_policy(policy(tmp_path, changed)))


@pytest.mark.parametrize("network", [{"num_skills": 10**9}, {"hidden_size": 10**6}])
def test_a_network_of_absurd_size_is_refused_by_arithmetic(
    tmp_path: Path, network: dict[str, int]
) -> None:
    assert next(iter(network)) in refusal(lambda: find_policy(policy(tmp_path, {}, network)))


@pytest.mark.parametrize("action", [5, -1, 10**12, 1.0, "1", None, True, [1], np.array([1, 2])])
def test_what_is_no_action_is_refused(action: Any) -> None:
    world, key = small_room(9), jax.random.key(0)
    state = jax.eval_shape(lambda key: reset(key, world)[1], key)
    assert "action is" in refusal(lambda: step(key, state, action, world))
    assert "key is" in refusal(lambda: reset(0, world))  # type: ignore[arg-type]
    for pose in ([np.nan, 1, 0], [-1, 1, 0], [1, 1e6, 0], [1, 1], None):
        assert "pose is" in refusal(lambda pose=pose: reset_to(key, pose, np.ones(2), world))
