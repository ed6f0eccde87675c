"""The progress of a command, on standard error."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

from sqn_jax.outside.messages import say

MANY_MAPS = 20
"""So many take long to prepare: on a slow machine minutes for some hundred."""


def episodes_bar(total: int, done: int = 0, *, is_shown: bool = True) -> tqdm[Any]:
    """A progress bar over episodes; updated less often where stderr is not a terminal."""
    return tqdm(
        total=total,
        initial=done,
        mininterval=0.5 if sys.stderr is not None and sys.stderr.isatty() else 20,
        smoothing=0.1,
        dynamic_ncols=True,
        disable=sys.stderr is None or not is_shown,  # A process may be started without one.
        bar_format="{percentage:3.0f}%|{bar:12}| {n_fmt}/{total_fmt} episodes "
        "[{elapsed}, {remaining} left{postfix}]",
    )


def phase(name: str) -> None:
    """Say what a command does now, where it has no bar for it."""
    say(f"{name} ...", error=True, flush=True)


def preparing(num_maps: int) -> None:
    """Say that maps are prepared, where they are so many that it takes a while."""
    if num_maps >= MANY_MAPS:
        phase(f"preparing {num_maps} maps")
