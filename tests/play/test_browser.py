"""The page in a real browser: Chromium, headless, as a person uses it with mouse and keyboard.

Needs chromium, chromedriver and selenium (the extra `browser`); skipped where one is missing.
"""

from __future__ import annotations

import base64
import dataclasses
import itertools
import json
import shutil
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sqn_jax.maps import load_map
from sqn_jax.maps.occupancy import OccupancyMap
from sqn_jax.play.page import PlayTask, play_page
from sqn_jax.policies.pretrained import find_policy

pytestmark = pytest.mark.browser

HOSTILE = "</script><img src=x onerror=\"document.title='taken'\">"
SIZE = 6.0  # m of the open room's sides.
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--window-size=1280,800", "--hide-scrollbars"),
)


def open_room(name: str = "room") -> OccupancyMap:
    """A room without obstacles, whose evaluation points face each other."""
    occupied = np.ones((120, 120), dtype=bool)
    occupied[1:-1, 1:-1] = False
    points = np.array([[1.0, 3.0], [5.0, 3.0]])
    return OccupancyMap(name, occupied, SIZE / 120, points, points)


class Tab:
    """A page in the browser, and what a person does there."""

    def __init__(self, driver: Any, folder: Path) -> None:
        self.driver = driver
        self.folder = folder

    def open(self, html: str, hash_: str = "", name: str = "play.html") -> None:
        """Show a page afresh."""
        path = self.folder / name
        path.write_text(html, encoding="utf-8")
        self.driver.get("about:blank")
        self.driver.get(path.as_uri() + hash_)

    def find(self, selector: str) -> Any:
        return self.driver.find_element("css selector", selector)

    def text(self, selector: str) -> str:
        return str(self.find(selector).text)

    def run(self, script: str, *given: Any) -> Any:
        return self.driver.execute_script(script, *given)

    def until(self, holds: Callable[[], Any], what: str, seconds: float = 20) -> None:
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, f"not within {seconds:g} s: {what}"
            time.sleep(0.02)

    def set(self, selector: str, value: str, event: str = "input") -> None:
        code = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('%s'))"
        self.run(code % event, self.find(selector), value)

    def pixel(self, x: float, y: float, width: float = SIZE, height: float = SIZE) -> list[int]:
        """Where a place of a map is, from the middle of its canvas."""
        size = self.find("#map").size
        scale = min(size["width"] / width, size["height"] / height)
        return [round((x - width / 2) * scale), round((height / 2 - y) * scale)]

    def drag(self, *places: tuple[float, float]) -> None:
        """Press at the first place, move over the others, let go."""
        from selenium.webdriver.common.action_chains import ActionChains

        pixels = [self.pixel(*place) for place in places]
        actions = ActionChains(self.driver, duration=20)
        actions.move_to_element_with_offset(self.find("#map"), *pixels[0]).click_and_hold()
        for (x, y), (next_x, next_y) in itertools.pairwise(pixels):
            actions.move_by_offset(next_x - x, next_y - y)
        actions.release().perform()

    def press(self, *keys: str) -> None:
        from selenium.webdriver.common.action_chains import ActionChains

        ActionChains(self.driver, duration=0).send_keys(*keys).perform()

    def arrives(self) -> None:
        """Let the policy run at full speed until it says how it went."""
        self.set("#speed", "5")
        self.until(lambda: "reach" in self.text("#message"), "the end of an episode")


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One browser for all tests of the file."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    browser, remote = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or remote is None:
        pytest.skip("chromium and chromedriver are not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    started = webdriver.Chrome(options=options, service=webdriver.ChromeService(remote))
    try:
        yield started
    finally:
        started.quit()


@pytest.fixture
def tab(driver: Any, tmp_path: Path) -> Iterator[Tab]:
    """A tab that at the end has logged no error and asked for nothing but its own file."""
    emulated = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", emulated)
    downloads = {"behavior": "allow", "downloadPath": str(tmp_path)}
    driver.execute_cdp_cmd("Browser.setDownloadBehavior", downloads)
    tab = Tab(driver, tmp_path)
    yield tab
    assert driver.get_log("browser") == []
    assert [url for url in requested(driver) if not url.startswith(tmp_path.as_uri())] == []


def requested(driver: Any) -> list[str]:
    """Everything that the browser was asked to fetch since the last call, but for what it holds."""
    messages = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    urls = [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
    return [url for url in urls if not url.startswith(("data:", "blob:", "about:", "chrome"))]


@pytest.fixture(scope="module")
def html() -> str:
    policy = find_policy("pretrained:best")
    return play_page(policy, [open_room(), load_map("maze")], source="pretrained:best")


def test_the_policy_arrives_behind_a_wall_that_was_drawn(tab: Tab, html: str) -> None:
    tab.open(html)
    tab.arrives()
    direct = int(tab.text("#score-policy td"))
    assert "The policy reached the goal" in tab.text("#message")
    tab.drag((3.0, 1.5), (3.0, 4.5))
    tab.find("#restart").click()
    tab.find("#run").click()
    tab.until(lambda: "reach" in tab.text("#message"), "the end of an episode")
    assert "The policy reached the goal" in tab.text("#message")
    assert int(tab.text("#score-policy td")) > direct
    # From (1, 3) around an end of the wall at 1.4 or 4.6 m and to (5, 3): two legs of 2.56 m, and
    # a little more for the robot's radius.
    tab.until(lambda: tab.text("#score-path td:last-child").endswith("m"), "the shortest path")
    assert 5.12 < float(tab.text("#score-path td:last-child").split()[0]) < 5.6


def test_a_drawn_map_is_shared_saved_and_read_by_the_package(tab: Tab, html: str) -> None:
    tab.open(html)
    tab.find("#run").click()
    tab.find("#restart").click()
    tab.drag((3.0, 1.5), (3.0, 4.5))
    tab.drag((5.0, 2.0), (5.0, 4.0))  # Through the goal.
    tab.drag((1.0, 3.0), (1.5, 2.0))
    tab.find("#share").click()
    tab.until(lambda: "#" in tab.driver.current_url, "a link")
    shared = tab.driver.current_url.split("#")[1]
    assert len(shared) < 2000
    tab.open(html, f"#{shared}")
    tab.until(lambda: tab.find("#maps option:checked").text == "shared map", "the shared map")
    tab.find("#save").click()
    tab.set("#save-name", "../my room", "change")
    tab.until(lambda: tab.text("#save-png") == "_my_room.png", "the files' names")
    tab.find("#save-png").click()
    tab.find("#save-yaml").click()
    files = [tab.folder / name for name in ("_my_room.png", "_my_room.yaml")]
    tab.until(lambda: all(path.exists() for path in files), "the files")
    loaded = load_map(files[1])
    occupied = loaded.occupied
    assert (occupied.shape, loaded.resolution, loaded.max_steps) == ((120, 120), 0.05, 400)
    assert occupied[30:90, 60].all()
    assert not occupied[25:95, :55][:, 1:].any()
    assert not occupied[25:95, 66:95].any()
    assert occupied[42:54, 100].all()
    assert not occupied[57:63, 95:105].any()
    np.testing.assert_allclose(loaded.evaluation_points, [[1.5, 2.0], [5.0, 3.0]], atol=0.03)
    assert "sqn map check _my_room.yaml" in tab.text("#save-commands")


def test_an_image_becomes_a_map(tab: Tab, html: str) -> None:
    gray = np.full((60, 80), 255, np.uint8)
    gray[:10], gray[30:, 40] = 0, 205
    Image.fromarray(gray).save(tab.folder / "drawing.png")
    tab.open(html)
    tab.find("#load").send_keys(str(tab.folder / "drawing.png"))
    tab.until(lambda: tab.find("#load-dialog").is_displayed(), "the dialog")
    tab.set("#load-resolution", "0.1")
    tab.find("#load-dialog .main").click()
    tab.until(lambda: tab.find("#maps option:checked").text == "drawing", "the loaded map")
    tab.find("#save").click()
    tab.until(lambda: tab.find("#save-png").get_attribute("href"), "the links")
    tab.find("#save-png").click()
    tab.until((tab.folder / "my_map.png").exists, "the file")
    expected = np.where(gray == 255, 254, 0)
    expected[[0, -1]], expected[:, [0, -1]] = 0, 0
    saved = np.asarray(Image.open(tab.folder / "my_map.png").convert("L"))
    np.testing.assert_array_equal(saved, expected)


def test_a_person_drives_with_the_keys_and_the_policy_keeps_pace(tab: Tab, html: str) -> None:
    from selenium.webdriver.common.keys import Keys

    tab.open(html)
    tab.find("#drivers label:last-of-type").click()
    steps = [tab.text(f"#score-{who} td") for who in ("you", "policy")]
    assert steps == ["0", "0"]
    for count, key in enumerate(("w", Keys.ARROW_UP, "a"), start=1):
        tab.press(key)
        tab.until(lambda n=count: tab.text("#score-you td") == str(n), "a step")
    assert tab.text("#score-policy td") == "3"
    tab.find("#pad button").click()
    tab.until(lambda: int(tab.text("#score-you td")) >= 4, "a step by the button")


def test_all_is_done_by_keyboard(tab: Tab, html: str) -> None:
    from selenium.webdriver.common.keys import Keys

    tab.open(html)
    tab.run("document.getElementById('map').focus()")
    tab.press(" ")
    tab.until(lambda: tab.text("#run") == "Run", "the pause")
    before = int(tab.text("#score-policy td"))
    tab.press(".")
    tab.until(lambda: tab.text("#score-policy td") == str(before + 1), "one step")
    tab.press(*[Keys.ARROW_UP] * 4, Keys.ENTER)
    tab.until(lambda: tab.find("#undo").is_enabled(), "a wall")
    assert tab.find("#maps option:checked").text == "room, edited"
    tab.driver.execute_cdp_cmd("Input.dispatchKeyEvent", control_z("rawKeyDown"))
    tab.until(lambda: not tab.find("#undo").is_enabled(), "the undo")
    tab.press("g", " ")
    tab.arrives()
    reachable = tab.run(
        "return [...document.querySelectorAll('button, select, input, summary, #map')]"
        ".filter((e) => e.offsetParent && e.tabIndex < 0).length"
    )
    assert reachable == 0


def control_z(kind: str) -> dict[str, Any]:
    key = {"key": "z", "code": "KeyZ", "windowsVirtualKeyCode": 90}
    return {"type": kind, "modifiers": 2, **key}


def squeezed(data: bytes) -> str:
    """Bytes as a link has them: deflated, in base64 for addresses."""
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    packed = packer.compress(data) + packer.flush()
    return base64.urlsafe_b64encode(packed).decode().rstrip("=")


@pytest.mark.parametrize(
    ("link", "says"),
    [
        ("#map=nowhere", "not in this page"),
        ("#size=120,120&resolution=0.05&cells=AAAA", "damaged"),
        ("#size=9000,9000&resolution=0.05&cells=AAAA", "9000 x 9000"),
        ("#map=room&start=1,2&goal=3,4", "start"),
        # Packed well, and not for the map that it says it is.
        (f"#size=80,80&resolution=0.05&cells={squeezed(bytes(799))}", "damaged"),
        (f"#size=80,80&resolution=0.05&cells={squeezed(bytes(10**8))}", "damaged"),
        (f"#size=8,40000&resolution=1&cells={squeezed(bytes(40_000))}", "too large"),
    ],
)
def test_a_damaged_link_is_named_and_the_page_goes_on(
    tab: Tab, html: str, link: str, says: str
) -> None:
    tab.open(html, link)
    tab.until(lambda: says in tab.text("#message"), "a line about the link")
    assert tab.find("#maps option:checked").text == "room"
    tab.arrives()


def test_hostile_names_are_inert(tab: Tab) -> None:
    policy = dataclasses.replace(find_policy("pretrained:best"), name=HOSTILE)
    tab.open(play_page(policy, [open_room(HOSTILE)], source=HOSTILE))
    tab.arrives()
    assert tab.driver.title.startswith(HOSTILE)
    assert tab.find("#maps option:checked").text == HOSTILE
    assert HOSTILE in tab.text("#policy-name")
    assert tab.run("return document.images.length") == 0


def test_should_markup_get_in_it_can_not_run(tab: Tab, html: str) -> None:
    tab.open(html)
    title = tab.driver.title
    tab.run("document.body.insertAdjacentHTML('beforeend', arguments[0])", HOSTILE)
    tab.run(
        "const s = document.createElement('script'); s.textContent = \"document.title = 'taken'\";"
        "document.body.append(s)"
    )
    blocked = []
    tab.until(
        lambda: blocked.extend(tab.driver.get_log("browser")) or len(blocked) >= 2, "the refusal"
    )
    assert tab.driver.title == title
    assert all("Content Security Policy" in entry["message"] for entry in blocked[:2])
    tab.driver.get_log("browser")
    requested(tab.driver)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone(tab: Tab, html: str, scheme: str) -> None:
    emulated = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    tab.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", emulated)
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    tab.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    tab.open(html)
    tab.arrives()
    assert tab.run("return document.documentElement.scrollWidth") == 390
    color = tab.run("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, color[4:-1].split(","))) > 384) == (scheme == "light")


def test_it_begins_at_once_with_the_task_that_it_was_given(tab: Tab) -> None:
    task = PlayTask((1.0, 1.0, 0.0), (1.9, 1.0))
    policy = find_policy("pretrained:best")
    tab.open(play_page(policy, [open_room()], source="pretrained:best", task=task))
    tab.arrives()
    tab.until(lambda: tab.text("#score-path td:last-child") == "0.9 m", "the shortest path")
