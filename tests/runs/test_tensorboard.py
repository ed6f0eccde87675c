"""Event files read back record by record."""

from __future__ import annotations

import io
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sqn_jax.runs import tensorboard
from sqn_jax.runs.tensorboard import Board

pytest.importorskip("tensorboardX")


def events(run_dir: Path) -> list[Any]:
    """All events of a run. A record is a length of 8 bytes, 4 of checksum, data, 4 of checksum."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted((run_dir / "tensorboard").iterdir()):
        data, place = path.read_bytes(), 0
        while place < len(data):
            (length,) = struct.unpack_from("<Q", data, place)
            found.append(Event.FromString(data[place + 12 : place + 12 + length]))
            place += length + 16
    return found


def scalars(run_dir: Path) -> list[tuple[str, int, float]]:
    return [
        (value.tag, event.step, value.simple_value)
        for event in events(run_dir)
        for value in event.summary.value
        if value.HasField("simple_value")
    ]


def test_a_row_becomes_one_number_a_curve_over_the_episodes(tmp_path: Path) -> None:
    row = {"chunk": 3, "episodes": 48, "success": 0.5, "loss": math.nan, "discount": None}
    with Board(tmp_path) as board:
        board.scalars(row | {"skill_usage": [0.25, 0.75], "epsilon": [[0.5], [1.0]]})
    assert scalars(tmp_path) == [
        ("success", 48, 0.5),
        ("skill_usage/0", 48, 0.25),
        ("skill_usage/1", 48, 0.75),
        ("epsilon/0/0", 48, 0.5),
        ("epsilon/1/0", 48, 1.0),
    ]


def test_a_picture_comes_back_pixel_by_pixel(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    with Board(tmp_path) as board:
        board.picture("trajectories", file.getvalue(), 96)
    (image,) = (
        (event.step, value)
        for event in events(tmp_path)
        for value in event.summary.value
        if value.HasField("image")
    )
    step, value = image
    assert (step, value.tag) == (96, "trajectories")
    with Image.open(io.BytesIO(value.image.encoded_image_string)) as found:
        np.testing.assert_array_equal(np.asarray(found.convert("RGB")), pixels)


def test_a_resumed_run_takes_back_what_it_will_write_again(tmp_path: Path) -> None:
    from tensorboardX.proto.event_pb2 import SessionLog

    with Board(tmp_path, episodes_done=32):
        pass
    starts = [
        event.step
        for event in events(tmp_path)
        if event.session_log.status == SessionLog.SessionStatus.Value("START")
    ]
    assert starts == [33]


def test_without_the_package_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tensorboard.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"--tensorboard: .*'sqn_jax\[tensorboard\]'"):
        tensorboard.require_tensorboard()
