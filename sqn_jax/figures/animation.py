"""An episode as a film: the map as the robot gets to know it, its own view, skills and reward.

What does not change is drawn once and kept as pixels. A frame is a copy of them into Matplotlib's
canvas, the map panel colored directly, pixel by pixel, and the few artists that move drawn on top.
"""

from __future__ import annotations

import contextlib
import io
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from sqn_jax.evaluation.recording import Episode
from sqn_jax.figures.screen import HEIGHT, KEY_COLORS, WIDTH, Screen, last_step, rgb
from sqn_jax.storage.files import written_whole

Frame = NDArray[np.uint8]

LAST_FRAME_MS = 1_000
"""How long the last frame stands, so that the end is seen before a GIF starts anew."""

PALETTE_FRAMES = 8
"""Frames that the palette of a GIF is made from."""

UNCHANGED = 255
"""The last of a GIF's 256 colors is transparent: there the frame before shows through. What does
not change takes hardly any room so."""


def frames(episode: Episode, *, count: int = 240, width_px: int = 800) -> Iterator[Frame]:
    """Draw a film of an episode, from its start until 2 s after the arrival.

    Without success the whole episode is shown. The frames are evenly spaced steps, all of them
    where there are no more than `count`.

    Args:
        episode: what happened.
        count: frames at most, 2 to 10,000.
        width_px: width of a frame, 320 to 3,840; its height is in proportion, both are even.

    Returns:
        The frames one by one, [h, w, 3] uint8 RGB.

    Raises:
        ValueError: `count` or `width_px` is out of its range.
    """
    steps = shown_steps(episode, count)
    screen = Screen(episode, *frame_size(width_px))
    return (screen.draw(int(step)) for step in steps)


def shown_steps(episode: Episode, count: int = 240) -> NDArray[np.intp]:
    """The indices 0..T of the states that a film of at most `count` frames shows.

    Raises:
        ValueError: `count` is out of its range.
    """
    if not 2 <= count <= 10_000:
        raise ValueError(f"count is {count}, expected 2 to 10000 frames")
    last = last_step(episode)
    return np.linspace(0, last, min(count, last + 1)).round().astype(np.intp)


def gif(
    episode: Episode, *, count: int = 240, frames_per_second: int = 20, width_px: int = 800
) -> bytes:
    """A film as an animated GIF that repeats; the last frame stands for a second.

    All frames share one palette, made from some of them and from the colors that mean something.

    Args:
        episode: what happened.
        count: see `frames`.
        frames_per_second: 1 to 50; a frame lasts a whole number of hundredths of a second.
        width_px: see `frames`.

    Raises:
        ValueError: an option is out of its range.
    """
    _check_rate(frames_per_second)
    steps = shown_steps(episode, count)
    screen = Screen(episode, *frame_size(width_px))
    some = np.linspace(0, len(steps) - 1, min(PALETTE_FRAMES, len(steps))).round().astype(int)
    palette = _Palette([screen.draw(int(steps[index])) for index in some])

    def images() -> Iterator[Image.Image]:
        before = None
        for step in steps:
            told = palette.indices(screen.draw(int(step)))
            fresh = told if before is None else np.where(told == before, UNCHANGED, told)
            before = told
            image = Image.fromarray(fresh.astype(np.uint8), "P")
            image.putpalette(palette.table.tobytes())
            yield image

    first, *others = images()
    duration = 10 * round(100 / frames_per_second)
    durations = [duration] * len(others) + [max(duration, LAST_FRAME_MS)]
    file = io.BytesIO()
    first.save(
        file,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=durations,
        loop=0,
        disposal=1,
        transparency=UNCHANGED,
        optimize=False,
    )
    return file.getvalue()


def mp4(
    path: str | Path,
    episode: Episode,
    *,
    count: int = 240,
    frames_per_second: int = 20,
    width_px: int = 800,
) -> None:
    """Write a film as MP4 (H.264), all or nothing; the last frame stands for a second.

    Args:
        path: the file, ending in .mp4, in a folder that exists.
        episode: what happened.
        count: see `frames`.
        frames_per_second: 1 to 50.
        width_px: see `frames`.

    Raises:
        ValueError: imageio-ffmpeg is not installed, an option is out of its range, or the file
            cannot be written.
    """
    path = Path(path)
    program = require_mp4()
    _check_rate(frames_per_second)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: the name ends in {path.suffix!r}, expected .mp4")
    film = frames(episode, count=count, width_px=width_px)
    width, height = frame_size(width_px)
    words = f"-loglevel error -y -f rawvideo -pix_fmt rgb24 -s {width}x{height} "
    words += f"-r {frames_per_second} -i - -an -c:v libx264 -crf 22 -pix_fmt yuv420p"
    words += " -movflags +faststart"
    with written_whole(path) as partial:
        # Not by imageio's writer: it forks, which JAX's threads may not survive.
        with subprocess.Popen(
            [program, *words.split(), str(partial)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        ) as encoder:
            assert encoder.stdin is not None
            with contextlib.suppress(BrokenPipeError):
                for frame in film:
                    encoder.stdin.write(frame.tobytes())
                for _ in range(frames_per_second * LAST_FRAME_MS // 1000 - 1):
                    encoder.stdin.write(frame.tobytes())
            _, complaint = encoder.communicate()
        if encoder.returncode != 0:
            told = complaint.decode(errors="replace").strip().splitlines() or ["no reason given"]
            raise ValueError(f"{path}: cannot be written (ffmpeg: {told[-1]})")


def require_mp4() -> str:
    """The program that writes MP4.

    Raises:
        ValueError: imageio-ffmpeg is not installed, or has no program for this machine.
    """
    try:
        import imageio_ffmpeg

        program: str = imageio_ffmpeg.get_ffmpeg_exe()
    except ImportError:
        raise ValueError(
            "MP4 needs imageio-ffmpeg, which is not installed (pip install 'sqn_jax[video]')"
        ) from None
    except RuntimeError as error:
        raise ValueError(f"MP4 needs a program that imageio-ffmpeg lacks here: {error}") from None
    return program


def _check_rate(frames_per_second: int) -> None:
    if not 1 <= frames_per_second <= 50:
        raise ValueError(f"frames_per_second is {frames_per_second}, expected 1 to 50")


def frame_size(width_px: int) -> tuple[int, int]:
    """Width and height of a frame, pixels, for the width asked for; both even, as MP4 needs them.

    Raises:
        ValueError: the width is out of its range.
    """
    if not 320 <= width_px <= 3_840:
        raise ValueError(f"width_px is {width_px}, expected 320 to 3840")
    width = 2 * round(width_px / 2)
    return width, 2 * round(width * HEIGHT / WIDTH / 2)


class _Palette:
    """The colors of a GIF: those that mean something, and others by how often they come.

    The first ones as they are, since the few pixels of a robot or a goal would not get a place.
    """

    def __init__(self, samples: list[Frame]) -> None:
        key_colors = np.unique([rgb(color) for color in KEY_COLORS], axis=0)
        stacked = Image.fromarray(np.concatenate(samples))
        others = stacked.quantize(UNCHANGED - len(key_colors), Image.Quantize.MEDIANCUT)
        found = np.asarray(others.getpalette(), np.uint8).reshape(-1, 3)
        table = np.concatenate([key_colors, found])[:UNCHANGED]
        self._tree = cKDTree(table)
        self.table = np.pad(table, ((0, 256 - len(table)), (0, 0)))
        """[256, 3] uint8."""
        self._known = np.full(2**24, -1, np.int16)

    def indices(self, frame: Frame) -> Frame:
        """[h, w] uint8, the nearest color of the palette for each pixel.

        Not by Pillow, which takes a near one for the nearest. A color is looked for once.
        """
        red, green, blue = np.moveaxis(frame.astype(np.int32), -1, 0)
        codes = red << 16 | green << 8 | blue
        told = self._known[codes]
        if (told < 0).any():
            new = np.unique(codes[told < 0])
            colors = np.stack([new >> 16, new >> 8 & 255, new & 255], axis=-1)
            self._known[new] = self._tree.query(colors)[1]
            told = self._known[codes]
        return told.astype(np.uint8)
