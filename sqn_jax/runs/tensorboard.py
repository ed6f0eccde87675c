"""TensorBoard: the metrics of a run while it trains, and its figures at the end.

Needs the extra `sqn_jax[tensorboard]`. View with `tensorboard --logdir RUN/tensorboard`.
"""

from __future__ import annotations

import importlib.util
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

FOLDER = "tensorboard"


def require_tensorboard() -> None:
    """Raise ValueError if tensorboardX is not installed."""
    if importlib.util.find_spec("tensorboardX") is None:
        raise ValueError(
            "--tensorboard: tensorboardX is not installed (pip install 'sqn_jax[tensorboard]')"
        )


class Board:
    """The event file of one run; use as a context manager."""

    def __init__(self, run_dir: Path, episodes_done: int = 0) -> None:
        """Open a file in `run_dir`/tensorboard.

        Args:
            run_dir: the run folder.
            episodes_done: episodes of a resumed run so far; later entries of earlier files are not
                shown.

        Raises:
            ValueError: tensorboardX is not installed, or the file cannot be written.
        """
        require_tensorboard()
        from tensorboardX import SummaryWriter

        purge: dict[str, Any] = {"purge_step": episodes_done + 1} if episodes_done else {}
        try:
            self._writer = SummaryWriter(str(run_dir / FOLDER), **purge)
        except OSError as error:
            raise ValueError(f"{run_dir / FOLDER}: cannot be written ({error.strerror})") from None

    def __enter__(self) -> Board:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def scalars(self, row: Mapping[str, Any]) -> None:
        """Add a row of metrics.jsonl; of a list, every entry has its own curve."""
        for name, value in row.items():
            if name in ("chunk", "episodes"):
                continue
            for index, number in np.ndenumerate(np.asarray(value, np.float64)):
                if math.isfinite(number):
                    tag = "/".join([name, *map(str, index)])
                    self._writer.add_scalar(tag, number, row["episodes"])
        self._writer.flush()

    def picture(self, name: str, png: bytes, episodes: int) -> None:
        """Add a PNG picture under a name, after this number of episodes."""
        with Image.open(io.BytesIO(png)) as image:
            pixels = np.asarray(image.convert("RGB"))
        self._writer.add_image(name, pixels, episodes, dataformats="HWC")
