"""An image outside the YAML file's folder: refused, unless the caller allows it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from map_files import pgm_bytes

from sqn_jax.cli import main
from sqn_jax.maps import image as image_module
from sqn_jax.maps import load_map

WAYS = ("up", "absolute", "link", "linked folder")


@pytest.fixture
def outside(tmp_path: Path, room: Callable[..., Path]) -> Callable[..., Path]:
    """Write inner/room.yaml, whose image is the file `name` one folder up."""

    def write(way: str, name: str = "room.pgm") -> Path:
        path = room()
        inner = tmp_path / "inner"
        inner.mkdir(exist_ok=True)
        for link, target in ((inner / "link.pgm", tmp_path / name), (inner / "folder", tmp_path)):
            link.unlink(missing_ok=True)
            link.symlink_to(target)
        names = (f"../{name}", str(tmp_path / name), "link.pgm", f"folder/{name}")
        written = dict(zip(WAYS, names, strict=True))[way]
        moved = path.rename(inner / "room.yaml")
        moved.write_text(moved.read_text().replace("room.pgm", written))
        return moved

    return write


def refusal(path: Path, **options: bool) -> str:
    with pytest.raises(ValueError, match="image: ") as caught:
        load_map(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: image: ")
    assert message.isprintable()
    return message


@pytest.mark.parametrize("way", WAYS)
def test_an_image_outside_is_refused_with_what_to_do(
    outside: Callable[..., Path], way: str
) -> None:
    message = refusal(outside(way))
    assert "copy the image beside the YAML file" in message
    assert "--allow-outside" in message
    assert "allow_outside=True" in message


def test_whether_a_file_outside_exists_is_not_told(outside: Callable[..., Path]) -> None:
    there, absent = refusal(outside("up")), refusal(outside("up", "none.pgm"))
    assert there.replace("room.pgm", "") == absent.replace("none.pgm", "")


@pytest.mark.parametrize("way", WAYS)
def test_an_image_outside_is_read_where_it_is_allowed(
    outside: Callable[..., Path], room: Callable[..., Path], way: str
) -> None:
    inside = load_map(room()).occupied
    np.testing.assert_array_equal(load_map(outside(way), allow_outside=True).occupied, inside)


def test_an_absolute_name_of_an_image_inside_needs_no_leave(
    room: Callable[..., Path], tmp_path: Path
) -> None:
    path = room()
    path.write_text(path.read_text().replace("room.pgm", str(tmp_path / "room.pgm")))
    assert load_map(path).shape == (92, 122)


@pytest.mark.parametrize("way", WAYS)
def test_what_is_no_image_is_refused_even_where_outside_is_allowed(
    outside: Callable[..., Path], tmp_path: Path, way: str
) -> None:
    (tmp_path / "secret").write_text("hunter2\n" * 99)
    (tmp_path / "empty").touch()
    (tmp_path / "folder.pgm").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name, expected in (
        ("secret", "contents of another kind"),
        ("empty", "bytes, got 0"),
        ("none", "no such file"),
        ("folder.pgm", "a folder"),
        ("pipe", "is a pipe"),
    ):
        message = refusal(outside(way, name), allow_outside=True)
        assert expected in message
        assert "hunter2" not in message
        assert "in the YAML file's folder" not in message


def test_a_device_is_refused_even_where_outside_is_allowed(room: Callable[..., Path]) -> None:
    path = room()
    path.write_text(path.read_text().replace("room.pgm", "/dev/zero"))
    assert "is a device" in refusal(path, allow_outside=True)


def test_the_caps_hold_outside_too(
    outside: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = outside("up")
    size = len(pgm_bytes(np.zeros((90, 120), dtype=np.uint8)))
    with monkeypatch.context() as patch:
        patch.setattr(image_module, "MAX_CELLS", 120 * 90 - 1)
        assert "120 x 90 pixels" in refusal(path, allow_outside=True)
    monkeypatch.setattr(image_module, "MAX_IMAGE_BYTES", size - 1)
    assert f"got {size}" in refusal(path, allow_outside=True)


def test_the_command_line_says_what_to_do_and_allows_it(
    outside: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(outside("up"))
    assert main(["map", "check", path]) == 2
    told = capsys.readouterr().err
    assert told.startswith("sqn: ")
    assert told.count("\n") == 1
    assert "--allow-outside" in told
    assert main(["map", "check", "--allow-outside", path]) == 0
    assert "122 x 92 cells" in capsys.readouterr().out
