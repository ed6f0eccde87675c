"""Animations of an episode: the map as the robot sees it, its own view, skills and reward.

The constant background is drawn once and stored as pixels. For a frame these are copied into the
canvas of Matplotlib, the pixels of the map panel are set directly, and the few moving artists are
drawn on top.
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

DEFAULT_FRAMES = 160
"""The largest number of frames: 8 s at 20 a second."""

LAST_FRAME_MS = 1_000
"""Duration of the last frame, so that the end can be seen before a GIF repeats."""

PALETTE_FRAMES = 8
"""Number of frames from which the palette of a GIF is made."""

UNCHANGED = 255
"""The last of the 256 colors of a GIF is transparent and shows the frame before, so that unchanged
pixels take hardly any space."""


def frames(
    episode: Episode, *, count: int = DEFAULT_FRAMES, width_px: int = 800
) -> Iterator[Frame]:
    """Draw an animation of an episode, from its start until 2 s after the arrival.

    Without success the whole episode is shown. The frames are evenly spaced steps, or all steps if
    there are no more than `count`.

    Args:
        episode: the episode.
        count: the largest number of frames, 2 to 10,000.
        width_px: width of a frame, 320 to 3,840; the height is proportional; both are even.

    Returns:
        An iterator over the frames, [h, w, 3] uint8 RGB.

    Raises:
        ValueError: `count` or `width_px` is out of its range.
    """
    steps = shown_steps(episode, count)
    screen = Screen(episode, *frame_size(width_px))
    return (screen.draw(int(step))[..., :3] for step in steps)


def shown_steps(episode: Episode, count: int = DEFAULT_FRAMES) -> NDArray[np.intp]:
    """The indices 0..T of the states in an animation of at most `count` frames.

    Raises:
        ValueError: `count` is out of its range.
    """
    if not 2 <= count <= 10_000:
        raise ValueError(f"count is {count}, expected 2 to 10000 frames")
    last = last_step(episode)
    return np.linspace(0, last, min(count, last + 1)).round().astype(np.intp)


def gif(
    episode: Episode,
    *,
    count: int = DEFAULT_FRAMES,
    frames_per_second: int = 20,
    width_px: int = 800,
) -> bytes:
    """An animated GIF that repeats; the last frame is shown for a second.

    All frames share one palette, made from some of them and from the colors with a meaning.

    Args:
        episode: the episode.
        count: see `frames`.
        frames_per_second: 1 to 50; a frame lasts a whole number of hundredths of a second.
        width_px: see `frames`.

    Returns:
        The GIF file.

    Raises:
        ValueError: an option is out of its range.
    """
    _check_rate(frames_per_second)
    steps = shown_steps(episode, count)
    screen = Screen(episode, *frame_size(width_px))
    samples = np.linspace(0, len(steps) - 1, min(PALETTE_FRAMES, len(steps))).round().astype(int)
    palette = _Palette([screen.draw(int(steps[index])) for index in samples])

    def images() -> Iterator[Image.Image]:
        before = None
        for step in steps:
            indices = palette.indices(screen.draw(int(step)))
            is_first = before is None
            shown = indices if is_first else np.where(indices == before, UNCHANGED, indices)
            before = indices
            image = Image.fromarray(shown.astype(np.uint8), "P")
            image.putpalette(palette.table.tobytes())
            yield image

    first, *others = images()
    duration = 10 * round(100 / frames_per_second)
    durations = [duration] * len(others) + [max(duration, LAST_FRAME_MS)]
    buffer = io.BytesIO()
    first.save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=durations,
        loop=0,
        disposal=1,
        transparency=UNCHANGED,
        optimize=False,
    )
    return buffer.getvalue()


def mp4(
    path: str | Path,
    episode: Episode,
    *,
    count: int = DEFAULT_FRAMES,
    frames_per_second: int = 20,
    width_px: int = 800,
) -> None:
    """Write an animation as MP4 (H.264), all or nothing; the last frame is shown for a second.

    Args:
        path: the file, ending in .mp4, in an existing folder.
        episode: the episode.
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
    images = frames(episode, count=count, width_px=width_px)
    width, height = frame_size(width_px)
    arguments = f"-loglevel error -y -f rawvideo -pix_fmt rgb24 -s {width}x{height} "
    arguments += f"-r {frames_per_second} -i - -an -c:v libx264 -crf 22 -pix_fmt yuv420p"
    arguments += " -movflags +faststart"
    with written_whole(path) as partial:
        # Not with the writer of imageio: it forks, which is unsafe with the threads of JAX.
        with subprocess.Popen(
            [program, *arguments.split(), str(partial)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        ) as encoder:
            assert encoder.stdin is not None
            with contextlib.suppress(BrokenPipeError):
                for frame in images:
                    encoder.stdin.write(frame.tobytes())
                for _ in range(frames_per_second * LAST_FRAME_MS // 1000 - 1):
                    encoder.stdin.write(frame.tobytes())
            _, stderr = encoder.communicate()
        if encoder.returncode != 0:
            lines = stderr.decode(errors="replace").strip().splitlines() or ["no reason given"]
            raise ValueError(f"{path}: cannot be written (ffmpeg: {lines[-1]})")


def require_mp4() -> str:
    """The path of the program that writes MP4.

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
    """Width and height of a frame, pixels, for the requested width; both are even, as MP4 needs.

    Raises:
        ValueError: the width is out of its range.
    """
    if not 320 <= width_px <= 3_840:
        raise ValueError(f"width_px is {width_px}, expected 320 to 3840")
    width = 2 * round(width_px / 2)
    return width, 2 * round(width * HEIGHT / WIDTH / 2)


class _Palette:
    """The colors of a GIF: first those with a meaning, then others by frequency.

    The few pixels of a robot or a goal would not get a color of the palette by frequency.
    """

    def __init__(self, samples: list[Frame]) -> None:
        key_colors = np.unique([rgb(color) for color in KEY_COLORS], axis=0)
        stacked = Image.fromarray(np.concatenate(samples)[..., :3])
        others = stacked.quantize(UNCHANGED - len(key_colors), Image.Quantize.MEDIANCUT)
        other_colors = np.asarray(others.getpalette(), np.uint8).reshape(-1, 3)
        table = np.concatenate([key_colors, other_colors])[:UNCHANGED]
        self._tree = cKDTree(table)
        self.table = np.pad(table, ((0, 256 - len(table)), (0, 0)))
        """[256, 3] uint8."""
        self._cache = np.full(2**24, -1, np.int16)

    def indices(self, frame: Frame) -> Frame:
        """[h, w] uint8, the nearest color of the palette for each pixel [h, w, 4] RGBA.

        Not with Pillow, which does not always find the nearest. The result is cached by color.
        """
        codes = frame.view("<u4")[..., 0] & 0xFFFFFF
        indices = self._cache[codes]
        if (indices < 0).any():
            new = np.unique(codes[indices < 0])
            colors = np.stack([new & 255, new >> 8 & 255, new >> 16], axis=-1)
            self._cache[new] = self._tree.query(colors)[1]
            indices = self._cache[codes]
        return indices.astype(np.uint8)
