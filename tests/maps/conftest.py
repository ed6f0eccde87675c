"""The fixture `room`: a small map file of this test's own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from map_files import write_room


@pytest.fixture
def room(tmp_path: Path) -> Callable[..., Path]:
    """`write_room` into this test's own folder."""

    def write(**changes: object) -> Path:
        return write_room(tmp_path, **changes)  # type: ignore[arg-type]

    return write
