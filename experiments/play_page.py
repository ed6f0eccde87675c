"""docs/play.html and the pictures of it. `gallery.py` calls this.

The pictures need Chromium with its chromedriver and the extra `browser`.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.play.page import PlayTask, maps_of_page, play_page
from sqn_jax.policies.pretrained import find_policy

POLICY = "pretrained:best"
STEPS = 120
"""After so many steps the picture of the page is taken."""
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--hide-scrollbars", "--window-size=1280,800"),
)
SIZE, CELL = 17.0, 0.05
TRAP_WALLS = ((2.0, 12.0, 14.0, 12.2), (2.0, 4.8, 14.0, 5.0), (13.8, 4.8, 14.0, 12.2))
"""Left, bottom, right and top of walls, m: a pocket that opens away from the goal."""
TRAP_TASK = PlayTask((8.0, 8.5, 0.0), (16.0, 8.5))


def trap() -> OccupancyMap:
    """A map drawn to fool a policy: it has to drive away from the goal for a long time."""
    cells = round(SIZE / CELL)
    occupied = np.ones((cells, cells), dtype=bool)
    occupied[1:-1, 1:-1] = False
    for wall in TRAP_WALLS:
        left, bottom, right, top = (round(side / CELL) for side in wall)
        occupied[bottom:top, left:right] = True
    points = np.array([TRAP_TASK.start[:2], TRAP_TASK.goal])
    return OccupancyMap("trap", occupied, CELL, points, points)


def write_page(out: Path) -> None:
    """The page with the best policy that comes with the package, which begins in the maze."""
    policy = find_policy(POLICY)
    maps = maps_of_page(load_map("maze"), policy.config.env.robot_radius)
    out.write_text(play_page(policy, maps, source=POLICY), encoding="utf-8")


def take_pictures(page: Path, folder: Path) -> list[Path]:
    """Pictures of a page under way, and of the trap after its episode.

    Args:
        page: from `write_page`.
        folder: for play.png and play_trap.png.

    Returns:
        The files; none where there is no browser to take them with.
    """
    pictures = [folder / "play.png", folder / "play_trap.png"]
    with _browser() as driver, tempfile.TemporaryDirectory() as temporary:
        if driver is None:
            return []
        driver.get(page.resolve().as_uri())
        for button in ("run", "restart", *["step"] * STEPS):
            driver.execute_script(f"document.getElementById('{button}').click()")
        _take(driver, pictures[0])
        trap_page = Path(temporary) / "trap.html"
        policy = find_policy(POLICY)
        html = play_page(policy, [trap()], source=POLICY, task=TRAP_TASK)
        trap_page.write_text(html, encoding="utf-8")
        driver.get(trap_page.as_uri())
        driver.execute_script(
            "const speed = document.getElementById('speed');"
            "speed.value = 5; speed.dispatchEvent(new Event('input'))"
        )
        while "steps" not in driver.find_element("id", "message").text:
            time.sleep(0.1)
        _take(driver, pictures[1])
    return pictures


def _take(driver: Any, file: Path) -> None:
    time.sleep(0.5)
    driver.save_screenshot(str(file))


@contextmanager
def _browser() -> Iterator[Any]:
    """Chromium with an empty profile; None where it, its driver or selenium is missing."""
    try:
        from selenium import webdriver
    except ModuleNotFoundError:
        yield None
        return
    chromium, remote = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or remote is None:
        yield None
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = chromium
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(remote))
        try:
            metrics = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            yield driver
        finally:
            driver.quit()
