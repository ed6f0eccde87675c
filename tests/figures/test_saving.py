"""What is saved is a whole picture or the old one, the same bytes each time."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import pytest
from drawing import metrics_row as row
from episodes import episode
from matplotlib import pyplot
from PIL import Image

from sqn_jax import figures
from sqn_jax.figures import style


def test_a_saved_figure_is_a_png_of_the_figures_size_and_nothing_else_is_left(
    tmp_path: Path,
) -> None:
    figure = figures.learning_curve([row(1), row(2)], title="a run")
    path = tmp_path / "run" / "figures" / "curve.png"
    figures.save(figure, path)
    with Image.open(path) as image:
        image.load()
        assert image.format == "PNG"
        assert image.width == round(style.WIDTH_IN * style.DPI)
    assert [p.name for p in path.parent.iterdir()] == ["curve.png"]


def test_the_same_figure_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        figures.save(figures.skill_trajectories([episode()], title="SQN"), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_save_that_breaks_off_leaves_the_old_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "curve.png"
    path.write_bytes(b"old")
    figure = figures.learning_curve([row(1)], title="a run")

    def half_written(target: Path, **_: Any) -> None:
        with open(target, "wb") as file:
            file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(figure, "savefig", half_written)
    with pytest.raises(ValueError, match=r"curve\.png: cannot be written \(No space left"):
        figures.save(figure, path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["curve.png"]


def test_an_unusable_path_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    figure = figures.learning_curve([row(1)], title="a run")
    with pytest.raises(ValueError, match="cannot be written"):
        figures.save(figure, tmp_path / "file" / "curve.png")
    with pytest.raises(ValueError, match=r"expected \.png"):
        figures.save(figure, tmp_path / "curve.pdf")


def test_a_picture_is_the_png_that_would_be_saved(tmp_path: Path) -> None:
    def figure() -> Any:
        return figures.skill_trajectories([episode()], title="SQN")

    shown = figures.picture(figure())
    figures.save(figure(), tmp_path / "a.png")
    assert shown._repr_png_() == shown.png == (tmp_path / "a.png").read_bytes()
    with Image.open(io.BytesIO(shown.png)) as image:
        image.load()
        assert image.format == "PNG"
        assert image.width == round(style.WIDTH_IN * style.DPI)
    assert len(repr(shown)) < 100


def test_no_figure_is_left_in_the_list_of_open_windows() -> None:
    figures.learning_curve([row(1)], title="a run")
    figures.skill_trajectories([episode()], title="SQN")
    assert pyplot.get_fignums() == []
