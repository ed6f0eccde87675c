"""Thousands of damaged map files: each is refused in one clear line, or it is still a map."""

from __future__ import annotations

import random
import resource
import sys
import time
import warnings
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from image_mutations import PNG, PNM, mutated_png, mutated_pnm, pnm_bytes
from mutations import MOVINGAI, YAML, mutated_bytes, mutated_movingai, mutated_yaml

from sqn_jax.config.map_names import MAX_RESOLUTION, MIN_RESOLUTION
from sqn_jax.maps import MAX_CELLS, OccupancyMap, describe, load_map, validate
from sqn_jax.maps.ros import MAX_PLACE

EXAMPLES = {"YAML": 1500, "MovingAI": 300} | dict.fromkeys([*PNM, *PNG], 200)  # 4,000 in all
SECONDS = 20.0
"""For one file. Most take some milliseconds; a machine may be slow and shared."""
MEMORY = 2**29
"""Bytes by which all files of a kind may raise the peak of the process."""


def peak_memory() -> int:
    """The largest resident size of this process so far, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def assert_usable(loaded: OccupancyMap, robot_radius: float) -> None:
    """A map on which episodes can run, all its numbers in range."""
    validate(loaded, robot_radius)
    assert loaded.occupied.dtype == np.bool_
    rows, cols = loaded.occupied.shape
    assert rows >= 3
    assert cols >= 3
    assert rows * cols <= MAX_CELLS
    for edge in (loaded.occupied[[0, -1]], loaded.occupied[:, [0, -1]]):
        assert edge.all()
    assert MIN_RESOLUTION <= loaded.resolution <= MAX_RESOLUTION
    for points in (loaded.spawn_points, loaded.evaluation_points):
        assert points.shape == (len(points), 2)
        assert np.isfinite(points).all()
        assert (points > 0).all()
        assert (points < (cols * loaded.resolution, rows * loaded.resolution)).all()
        assert np.isfinite(loaded.to_map_frame(points)).all()
    assert max(map(abs, loaded.origin)) <= MAX_PLACE
    assert 0 <= loaded.spawn_radius <= MAX_PLACE
    assert isinstance(loaded.max_steps, int)
    assert 1 <= loaded.max_steps <= 1_000_000
    assert loaded.name in describe(loaded, robot_radius)


def assert_refused_or_usable(path: Path, robot_radius: float) -> str:
    """Load a file and check whatever comes of it; which it was."""
    began = time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            loaded = load_map(path, robot_radius=robot_radius)
        except ValueError as error:
            loaded, told = None, str(error)
        if loaded is not None:
            assert_usable(loaded, robot_radius)
    assert time.monotonic() - began < SECONDS
    assert {warning.category for warning in caught} <= {UserWarning}
    if loaded is None:
        assert told.startswith(f"{path}: ")
        assert len(told.removeprefix(str(path))) < 500
        assert told.isprintable(), told
        return "refused"
    assert tuple(str(warning.message) for warning in caught) == loaded.warnings
    return "usable"


def mutated(kind: str, rng: random.Random) -> tuple[str, bytes]:
    """The name and the bytes of a file damaged in what it says, in its bytes, or in both."""
    if kind == "YAML":
        name, sound, hostile = "room.yaml", YAML, mutated_yaml
    elif kind == "MovingAI":
        name, sound, hostile = "room.map", MOVINGAI, mutated_movingai
    elif kind in PNM:
        name, sound, hostile = "room.pgm", pnm_bytes(*PNM[kind]), partial(mutated_pnm, *PNM[kind])
    else:  # Named .pgm all the same: the suffix of an image says nothing.
        name, sound, hostile = "room.pgm", PNG[kind], partial(mutated_png, PNG[kind])
    what = rng.random()
    data = hostile(rng) if what < 0.6 else sound
    return name, data if what < 0.5 else mutated_bytes(data, rng)


@pytest.mark.parametrize("kind", EXAMPLES)
def test_a_mutated_file_is_refused_in_one_line_or_is_a_usable_map(
    tmp_path: Path, kind: str
) -> None:
    (tmp_path / "room.yaml").write_bytes(YAML)
    (tmp_path / "room.pgm").write_bytes(pnm_bytes(*PNM["binary PGM"]))
    outcomes: Counter[str] = Counter()
    before = peak_memory()
    for number in range(EXAMPLES[kind]):
        rng = random.Random(f"{kind} {number}")
        name, data = mutated(kind, rng)
        (tmp_path / name).write_bytes(data)
        path = tmp_path / name.replace(".pgm", ".yaml")
        try:
            outcomes[assert_refused_or_usable(path, rng.choice((0.0, 0.1, 0.1)))] += 1
        except BaseException as error:
            error.add_note(f"{kind}, example {number}: {data[:200]!r}")
            raise
    assert peak_memory() - before < MEMORY
    # Were nearly all of one sort, the mutations would test little.
    assert min(outcomes["refused"], outcomes["usable"]) > EXAMPLES[kind] / 20, outcomes
