"""Rendering gets quicker with coarse pixels, and only the layout depends on the resolution."""

from __future__ import annotations

import pytest
from drawing import set_dpi

from sqn_jax import figures


@pytest.fixture(autouse=True)
def coarse_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    set_dpi(monkeypatch, 55)


@pytest.fixture
def full_pixels(coarse_pixels: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a user sees it."""
    set_dpi(monkeypatch, figures.DPI)
