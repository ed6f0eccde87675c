"""One HTML file out of the modules in `web/`, a policy and maps. It fetches and stores nothing."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from sqn_jax.maps import OccupancyMap, known_maps, load_map
from sqn_jax.play.map_data import map_data
from sqn_jax.play.policy_data import policy_data
from sqn_jax.policies.run_policies import Policy

_IMPORT = re.compile(r"^import \{[^}]*\} from '\./(\w+)\.js';\n", re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const)\b)", re.MULTILINE)
_PLACEHOLDER = re.compile(r"\{\{(\w+)\}\}")


@dataclass(frozen=True)
class PlayTask:
    """Where an episode on the page begins, and where its goal is; in the grid's frame."""

    start: tuple[float, float, float]
    """x m, y m, heading rad."""
    goal: tuple[float, float]
    """x m, y m."""

    @classmethod
    def across(cls, occupancy_map: OccupancyMap) -> PlayTask:
        """From the first evaluation point of a map to the last."""
        (x, y), goal = occupancy_map.evaluation_points[[0, -1]].tolist()
        return cls((x, y, math.pi / 2), tuple(goal))


def maps_of_page(first: OccupancyMap, robot_radius: float) -> list[OccupancyMap]:
    """The maps that one can choose on a page: one of the user's, then the project's own.

    Those of the project in which a robot of this size finds no way are left out.
    """
    maps = [first]
    for name in known_maps():
        if name != first.name:
            with suppress(ValueError):
                maps.append(load_map(name, robot_radius=robot_radius))
    return maps


def play_page(
    policy: Policy, maps: Sequence[OccupancyMap], *, source: str, task: PlayTask | None = None
) -> str:
    """A page on which a policy moves through maps that one draws; the same input, the same text.

    Args:
        policy: with one training seed.
        maps: to choose from, by different names; the page begins with the first.
        source: what a command takes to find the policy, such as pretrained:best.
        task: the first one; across the first map by default.

    Raises:
        ValueError: the page does not compute such a policy, or a map is several side by side.
    """
    task = task or PlayTask.across(maps[0])
    data = {
        "policy": policy_data(policy),
        "maps": [map_data(occupancy_map) for occupancy_map in maps],
        "task": {"map": 0, "start": task.start, "goal": task.goal},
        "source": shlex.quote(source),
    }
    script, style = script_of("main"), _read("style.css")
    contents = {
        "title": escape(f"{policy.name}: draw walls, and watch it find its goal"),
        "style": style,
        "script": script,
        # A name may hold "</script>": nothing in the data can end its element.
        "data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "policy": (
            f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
            "img-src data: blob:; base-uri 'none'; form-action 'none'"
        ),
    }
    return _PLACEHOLDER.sub(lambda match: contents[match[1]], _read("page.html"))


def script_of(module: str) -> str:
    """A module of `web/` and those it imports as one script, each after those that it needs."""
    parts: dict[str, str] = {}

    def add(name: str) -> None:
        if name not in parts:
            text = _read(f"{name}.js")
            for needed in _IMPORT.findall(text):
                add(needed)
            parts[name] = _EXPORT.sub("", _IMPORT.sub("", text))

    add(module)
    return "\n".join(parts.values())


def _read(name: str) -> str:
    return files("sqn_jax.play").joinpath("web", name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """A text as a Content-Security-Policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
