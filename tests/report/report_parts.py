"""What the tests of reports share: made-up episodes, and a page read by its tags."""

from __future__ import annotations

import base64
import dataclasses
import io
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from PIL import Image

from sqn_jax.agent import QOutput, Trajectory
from sqn_jax.config import EnvConfig, TrainConfig
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.settings import Settings, World
from sqn_jax.maps import OccupancyMap
from sqn_jax.policies.run_policies import Policy
from sqn_jax.report.content import Content, Run
from sqn_jax.report.episodes import Place, WorstEpisode
from sqn_jax.training.rollout import EpisodeMetrics

EVIL = '<script>alert("x")</script><img src=http://evil.example/a.png>&amp;$\\frac$'


class Page(HTMLParser):
    """What a page holds: tags with their attributes, and its text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.rows: list[list[str]] = []
        self.cell: str | None = None
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.cell = ""

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th") and self.cell is not None:
            self.rows[-1].append(self.cell)
            self.cell = None

    def handle_data(self, data: str) -> None:
        self.text += data
        if self.cell is not None:
            self.cell += data

    def row(self, name: str) -> list[str]:
        """The cells of the one row of this name."""
        (cells,) = (row[1:] for row in self.rows if row and row[0] == name)
        return cells

    def images(self) -> list[Image.Image]:
        """The pictures, decoded; fails where one is not in the page itself."""
        found = []
        for tag, attributes in self.tags:
            if tag == "img":
                kind, data = (attributes["src"] or "").split(";base64,")
                image = Image.open(io.BytesIO(base64.b64decode(data, validate=True)))
                image.load()
                assert kind == f"data:image/{(image.format or '').lower()}"
                found.append(image)
        return found


def needs_nothing(page: Page, *links: str) -> None:
    """No tag of the page fetches, runs or leads anywhere, but for links to these addresses."""
    assert not {tag for tag, _ in page.tags} & {"script", "link", "iframe", "object", "base"}
    assert [attributes["href"] for tag, attributes in page.tags if tag == "a"] == list(links)
    for tag, attributes in page.tags:
        for name, value in attributes.items():
            if tag == "a":
                assert name == "href"
                continue
            assert not name.startswith("on"), (tag, name)
            if name in ("src", "href", "srcset", "style", "action"):
                assert (value or "").startswith("data:image/"), (tag, name, value)


def hall(name: str = "hall") -> OccupancyMap:
    """10 x 4 m with a wall along its middle, open at the right end; cells of 0.1 m.

    From (1, 1) to (1, 3) it is 2 m through the wall, and 2 x 8 m and a little around it.
    """
    occupied = np.zeros((40, 100), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[19:21, :85] = True
    points = np.array([[1.05, 1.05], [1.05, 3.05]])
    return OccupancyMap(name, occupied, 0.1, points, points)


def world_of(occupancy_map: OccupancyMap) -> World:
    params = SimpleNamespace(config=EnvConfig(), goal_radius=0.3)
    return World(occupancy_map, cast(Any, params), "evaluation points", (0.0, 0.0))


def batch_of(
    world: World, paths: list[Any], goals: list[tuple[float, float]], reached: list[int]
) -> EpisodeBatch:
    """Made-up episodes; `reached` is the step of the arrival, 0 for a failure.

    Every third move is refused.
    """
    poses = np.stack([np.pad(np.asarray(path, float), ((0, 0), (0, 1))) for path in paths], axis=1)
    length, count = len(poses) - 1, len(paths)
    steps = np.array([step or length for step in reached])
    metrics = EpisodeMetrics(np.array(reached) > 0, steps, *[np.zeros(count)] * 4)
    refused = np.repeat(np.arange(length)[:, None] % 3 == 2, count, axis=1)
    agent = TrainedAgent("sqn", (Policy("a", TrainConfig(seed=4), ({},)),))
    weights: Any = np.full((length, count, 2), 0.5)
    return EpisodeBatch(
        agent=agent,
        world=world,
        training_seed=4,
        eval_seed=1_000,
        metrics={0.3: metrics},
        starts=poses[0],
        goals=np.array(goals),
        trajectory=Trajectory(
            poses=poses, info={"collision": refused}, output=QOutput(weights, weights, weights)
        ),
    )


def line(start: tuple[float, float], end: tuple[float, float], steps: int) -> Any:
    return np.linspace(start, end, steps + 1)


def entry(agent: str, name: str, success: float, steps: float) -> dict[str, Any]:
    return {
        **{"agent": agent, "algorithm": agent, "map": name, "tasks": "evaluation points"},
        "success": {"mean": success, "ci95": [success / 2, (1 + success) / 2]},
        "time_steps": {"mean": steps},
    }


def evil_content() -> Content:
    """A content in which every name is hostile."""
    policy = Policy(EVIL, TrainConfig(map=EVIL, seed=4), ({},))
    run = Run(EVIL, policy, [], {"device": EVIL, "versions": {EVIL: EVIL}})
    agent = TrainedAgent(EVIL, (policy,))
    batch = batch_of(world_of(hall(EVIL)), [line((1.05, 1.05), (2, 1), 4)], [(9.05, 1.05)], [0])
    hard = WorstEpisode(dataclasses.replace(batch, agent=agent), 0, 8.0, 7.0, Place(2.0, 1.0, 2, 2))
    results = [entry(EVIL, EVIL, 0.5, 100.0)]
    settings = Settings(maps=(EVIL,), eval_seeds=1)
    return Content([run], [agent], settings, {"results": results}, [hard.batch], [hard])
