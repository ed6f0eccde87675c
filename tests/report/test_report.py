"""The report as a file: what it says of episodes and numbers; it needs nothing beside it."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
import pytest
from compiling import compiling_quickly
from PIL import Image
from rooms import write_empty_room

from sqn_jax.agent import QOutput, Trajectory
from sqn_jax.cli import main
from sqn_jax.config import Algorithm, EnvConfig, TrainConfig
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import make_env
from sqn_jax.evaluation.agents import EpisodeBatch, TrainedAgent
from sqn_jax.evaluation.settings import Settings, World
from sqn_jax.maps import OccupancyMap, load_map
from sqn_jax.policies.run_policies import Policy
from sqn_jax.report import read_runs
from sqn_jax.report.content import Content, Run, changed_settings
from sqn_jax.report.episodes import Place, WorstEpisode, densest_place, worst_episodes
from sqn_jax.report.page import describe_episode, lead, success_table, to_html
from sqn_jax.report.pictures import Illustration, Illustrations, curves
from sqn_jax.report.play import worst_to_play
from sqn_jax.storage.checkpoint import Checkpoints
from sqn_jax.storage.manifest import Origin
from sqn_jax.storage.run_folder import RunFolder
from sqn_jax.training.loop import make_program, start_run
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


def test_the_densest_place_is_the_one_that_counting_every_pair_finds() -> None:
    rng = np.random.default_rng(0)
    for length in (1, 2, 7, 60):
        points = np.cumsum(rng.normal(0, 0.5, (length, 2)), axis=0)
        counts = [
            sum(
                (x - other_x) ** 2 + (y - other_y) ** 2 <= 1.0
                for other_x, other_y in points.tolist()
            )
            for x, y in points.tolist()
        ]
        place = densest_place(points)
        assert (place.steps, place.of) == (max(counts), length)
        (index,) = np.flatnonzero((points == [place.x, place.y]).all(axis=1))
        assert counts[index] == max(counts)


def test_among_equally_dense_places_the_middle_one_is_named() -> None:
    # All within 1 m of each other; the sums of distances are 0.9, 0.6 and 0.9 + 0.0.
    place = densest_place(np.array([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0], [9.0, 9.0]]))
    assert place == Place(0.3, 0.0, 3, 4)


def test_failures_are_ranked_by_the_way_around_the_wall_not_through_it() -> None:
    world = world_of(hall())
    goal = (1.05, 3.05)
    behind_the_wall = line((5.05, 3.05), (1.05, 1.05), 8)  # 2 m off, more than 15 m to go.
    far_but_open = line((5.05, 1.05), (7.05, 3.05), 8)  # 6 m to go.
    at_hand = line((9.05, 3.05), (2.05, 3.05), 8)  # 1 m to go.
    arrived = line((9.05, 3.05), goal, 8)
    batches = [
        batch_of(world, [arrived, at_hand], [goal] * 2, [8, 0]),
        batch_of(world, [far_but_open, behind_the_wall], [goal] * 2, [0, 0]),
    ]
    found = worst_episodes(batches)
    assert [(hard.batch is batches[1], hard.episode) for hard in found] == [
        (True, 1),
        (True, 0),
        (False, 1),
    ]
    assert found[0].remaining_path > 15
    assert [hard.remaining_path for hard in found[1:]] == pytest.approx([6.0, 1.0], abs=0.1)
    assert [hard.shortest_path for hard in found] == pytest.approx(
        [4.0, found[1].shortest_path, 8.0], abs=0.1
    )


def test_too_few_failures_are_followed_by_the_slowest_beside_their_way() -> None:
    world = world_of(hall())
    goal = (1.05, 3.05)
    # 2.5 m a second and 0.1 s: 0.25 m a step. 5 m are 20 steps, 2 m are 8.
    paths = [line((6.05, 3.05), goal, 60), line((3.05, 3.05), goal, 60)]
    batch = batch_of(world, [*paths, paths[0], paths[1]], [goal] * 4, [40, 32, 0, 12])
    found = worst_episodes([batch])
    assert [hard.episode for hard in found] == [2, 1, 0]
    assert [hard.success for hard in found] == [False, True, True]
    assert found[1].slowness == pytest.approx(32 / 8, rel=0.02)
    assert found[2].slowness == pytest.approx(40 / 20, rel=0.02)
    assert len(worst_episodes([batch], count=9)) == 4
    assert [hard.remaining_path for hard in found] == pytest.approx([0.0, 0.0, 0.0], abs=0.1)


def test_the_words_say_where_a_robot_was_stuck_for_how_long_and_how_far_off() -> None:
    world = world_of(hall())
    # 12 steps, the last six of which: four at (8, 1), then away by 2 m. Before, all at (2, 1).
    path = [(2.04, 1.04)] * 7 + [(8.04, 1.04)] * 4 + [(6.04, 1.04)] * 2
    (hard,) = worst_episodes([batch_of(world, [path], [(9.04, 1.04)], [0])])
    description = describe_episode(hard)
    assert "not reached within 12 steps" in description
    assert "stuck: it spent 4 of the last 6 steps within 1 m of (8.0, 1.0) m" in description
    assert (
        "shortest path to the goal was 7.0 m from the start and 3.0 m from the end" in description
    )
    assert "from (2.0, 1.0) m to the goal at (9.0, 1.0) m" in description
    assert "There were 4 collisions." in description
    assert "sqn, training seed 4, in hall (evaluation points, episode 0" in description


def test_a_robot_that_was_nowhere_for_long_is_not_called_stuck() -> None:
    world = world_of(hall())
    path = line((1.05, 1.05), (8.65, 1.05), 8)
    (hard,) = worst_episodes([batch_of(world, [path], [(1.05, 3.05)], [0])])
    # The last four lie 0.95 m apart: the two in the middle have one neighbour on each side.
    assert "stuck: it spent 3 of the last 4 steps" in describe_episode(hard)
    swift = dataclasses.replace(hard, place=Place(6.0, 1.0, 1, 4))
    assert "stuck nowhere for long: at most it spent 1 of the last 4" in describe_episode(swift)


def test_of_a_success_only_the_way_to_the_goal_counts() -> None:
    world = world_of(hall())
    path = [(2.05, 1.05)] * 4 + [(8.05, 1.05)] * 9  # Reached at step 4, where it stays.
    (hard,) = worst_episodes([batch_of(world, [path], [(8.05, 1.05)], [4])])
    assert (hard.place.steps, hard.place.of) == (3, 4)
    assert hard.place.x == pytest.approx(2.05)
    assert hard.collisions == 1  # The third move; the others came after the arrival.


def entry(agent: str, name: str, success: float, steps: float) -> dict[str, Any]:
    return {
        **{"agent": agent, "algorithm": agent, "map": name, "tasks": "evaluation points"},
        "success": {"mean": success, "ci95": [success / 2, (1 + success) / 2]},
        "time_steps": {"mean": steps},
    }


RESULTS = [
    entry("sqn", "maze", 0.75, 123.4),
    entry("bug", "maze", 0.5, 200.0),
    entry("sqn", "hall", 0.25, 1234.5),
    entry("bug", "hall", 0.125, 300.25),
]


def test_the_table_holds_the_evaluation_s_numbers_and_the_paper_s_beside_them() -> None:
    page = Page(success_table(RESULTS, Settings(maps=("maze", "hall.yaml"))))
    assert page.rows[0] == ["", "maze", "hall"]
    assert page.row("sqn") == ["0.75 [0.38, 0.88]", "123.4", "0.25 [0.12, 0.62]", "1,234.5"]
    assert page.row("bug (wall follower)")[:2] == ["0.50 [0.25, 0.75]", "200.0"]
    assert page.row("the paper, SQN") == ["0.98", "181.1", "", ""]  # Table I of the paper.


def test_a_user_s_own_map_called_maze_is_not_set_beside_the_paper_s() -> None:
    page = Page(success_table(RESULTS, Settings(maps=("my/maze.yaml", "hall.yaml"))))
    assert "paper" not in page.text
    pairs = [{**each, "tasks": "random pairs"} for each in RESULTS]
    assert "paper" not in Page(success_table(pairs, Settings(maps=("maze", "hall.yaml")))).text


def test_what_differs_from_the_nearest_preset_is_named_and_nothing_else() -> None:
    config = PRESETS["quick"]
    learner = dataclasses.replace(config.learner, discount=0.9)
    changed = dataclasses.replace(config, map="cave", learner=learner)
    assert changed_settings(changed) == (
        "quick",
        [("map", "cave", "maze"), ("learner.discount", 0.9, 0.985)],
    )
    assert changed_settings(PRESETS["paper"]) == ("paper", [])


def picture(kind: str) -> Illustration:
    file = io.BytesIO()
    Image.new("P", (3, 2)).save(file, format=kind)
    return Illustration(file.getvalue(), EVIL, EVIL)


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


def test_hostile_names_are_text_and_nothing_else() -> None:
    pictures = Illustrations([picture("PNG")], [], [picture("PNG")], 3, picture("GIF"))
    html = to_html(evil_content(), pictures)
    page = Page(html)
    needs_nothing(page)
    assert [image.format for image in page.images()] == ["PNG", "PNG", "GIF"]
    assert html.count("<img ") == 3
    assert "<script" not in html
    # Title, heading, first sentence, worst episode twice, table twice, captions, settings.
    assert page.text.count(EVIL) >= 11
    assert "3 more pictures are left out" in page.text
    whole = re.search(r"<pre>(.*?)</pre>", html, re.DOTALL)
    assert whole is not None
    assert json.loads(unescape(whole[1]))["map"] == EVIL


def test_hostile_names_are_inert_in_the_page_to_play_on_and_in_the_link_to_it() -> None:
    content = evil_content()
    playable = worst_to_play(content, f"{EVIL}-play.html")
    (link,) = playable.links
    assert re.fullmatch(r"[\w%.,#=&-]+", str(link), re.ASCII)
    assert unquote(str(link)).startswith(f"{EVIL}-play.html#map={EVIL}&start=1.05")
    page = Page(
        to_html(content, Illustrations([picture("PNG")], [], [], 0, picture("GIF")), [link])
    )
    needs_nothing(page, str(link))
    tags = [tag for tag, _ in Page(playable.html).tags]
    assert tags.count("script") == 2
    assert "img" not in tags


def test_the_first_sentence_tells_success_and_steps_of_each_map() -> None:
    content = dataclasses.replace(
        evil_content(),
        agents=[TrainedAgent("sqn", ())],
        evaluation={"results": RESULTS},
        settings=Settings(maps=("maze", "hall")),
    )
    assert (
        lead(content) == "sqn has success 0.75 in maze (123 steps) and 0.25 in hall (1,234 steps)."
    )


@pytest.fixture(scope="module")
def room_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write_empty_room(tmp_path_factory.mktemp("map"))
    path.write_text(path.read_text() + "max_steps: 30\n")
    return path


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory, room_file: Path) -> Iterator[Path]:
    """A run as it stands before its first update, called as a formula that cannot be set."""
    path = tmp_path_factory.mktemp("runs") / "$x^$<b>"
    smoke = PRESETS["smoke"]
    config = dataclasses.replace(
        smoke,
        map=str(room_file),
        network=dataclasses.replace(smoke.network, hidden_size=8),
        env=dataclasses.replace(smoke.env, max_steps=0),
    )
    folder = RunFolder.create(path, config)
    with compiling_quickly():
        world = make_env(load_map(room_file), config.env)
        runner = start_run(make_program(world, config))
        with Checkpoints(path, Origin(config)) as checkpoints:
            checkpoints.save(1, runner)
        for chunk in (1, 2):
            usage = {"gate_entropy": 0.6 / chunk, "skill_usage": [0.5, 0.5]}
            folder.append_metrics(
                {
                    "chunk": chunk,
                    "episodes": 32 * chunk,
                    "mean_reward": 0.1,
                    "success": 0.5,
                    **usage,
                }
            )
        yield path


def begins_with_the_worst(html: str, page: Page, links: list[str]) -> None:
    """The page beside a report has the task of its first episode; its links say those of all."""
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', html)
    assert data is not None
    task = json.loads(data[1])["task"]
    places = re.findall(r"from \((.*?), (.*?)\) m to the goal at \((.*?), (.*?)\) m", page.text)
    assert len(places) == len(links) == 2
    begun = [*task["start"][:2], *task["goal"]]
    assert [f"{value:.1f}" for value in begun] == list(places[0])
    for link, place in zip(links, places, strict=True):
        file, _, fields = link.partition("#")
        assert file == "my%201-play.html"
        numbers = dict(field.split("=") for field in fields.split("&"))
        assert numbers["map"] in html
        said = [*numbers["start"].split(",")[:2], *numbers["goal"].split(",")]
        assert [f"{float(value):.1f}" for value in said] == list(place)


def test_a_report_on_a_run_is_the_same_twice_and_says_what_an_evaluation_says(
    run_dir: Path, room_file: Path, tmp_path: Path
) -> None:
    arguments = [str(run_dir), "--episodes", "2", "--eval-seeds", "1", "--epsilon", "0.5"]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert main(["report", *arguments, "--out", str(tmp_path / name / "my 1.html")]) == 0
    files = ["my 1-play.html", "my 1.html"]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == files
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    html = (tmp_path / "a" / "my 1.html").read_text(encoding="utf-8")
    page = Page(html)
    links = [str(attributes["href"]) for tag, attributes in page.tags if tag == "a"]
    needs_nothing(page, *links)
    plays = (tmp_path / "a" / "my 1-play.html").read_text(encoding="utf-8")
    begins_with_the_worst(plays, page, links)
    images = page.images()
    # Two worst, the learning curve, the paths, the animation.
    assert [image.format for image in images] == ["PNG"] * 4 + ["GIF"]
    assert getattr(images[-1], "n_frames", 1) > 1
    found = tmp_path / "found.json"
    arguments += ["--maps", str(room_file), "--goal-radius", "0.3"]
    assert main(["evaluate", *arguments, "--out", str(found)]) == 0
    sqn = "sqn, epsilon 0.5"
    for name, row in ((sqn, sqn), ("oracle", "oracle (knows the map)")):
        own = next(
            each for each in json.loads(found.read_text())["results"] if each["agent"] == name
        )
        success, steps = page.row(row)
        assert success.startswith(f"{own['success']['mean']:.2f} [")
        assert steps == f"{own['time_steps']['mean']:.1f}"
    assert run_dir.name in page.text
    assert "2 episodes of each trained seed" in page.text
    assert "each action drawn at random with probability 0.5" in page.text


def test_one_run_has_its_curves_several_are_compared_and_one_without_metrics_has_none() -> None:
    def run(name: str, algo: Algorithm, rows: int, **without: Any) -> Run:
        row = {"mean_reward": 0.1, "success": 0.5, "gate_entropy": 0.6, "skill_usage": [0.5, 0.5]}
        remaining = {key: value for key, value in row.items() if key not in without}
        metrics = [{"episodes": 32 * chunk, **remaining} for chunk in range(1, rows + 1)]
        return Run(name, Policy(name, TrainConfig(algo=algo), ({},)), metrics, {})

    def count(*runs: Run) -> int:
        agents = [TrainedAgent(run.policy.config.algo, (run.policy,)) for run in runs]
        found = curves(dataclasses.replace(evil_content(), runs=list(runs), agents=agents))
        assert all(each.data.startswith(b"\x89PNG") for each in found)
        return len(found)

    formula = run("$x^$", "sqn", 3)
    assert count(formula) == 1
    assert count(formula, run("b", "dqn", 2)) == 2  # One has no skill decision.
    assert count(run("a", "sqn", 2, gate_entropy=True), run("b", "dqn", 2)) == 1
    assert count(formula, run("pretrained:b", "dqn", 0)) == 1
    assert count(run("pretrained:b", "sqn", 0)) == 0


def test_folders_of_the_same_name_are_told_apart(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def found(word: str, *_: int | str) -> Policy:
        return Policy(Path(word).name, TrainConfig(), ({},))

    monkeypatch.setattr("sqn_jax.report.content.find_policy", found)
    folders = [str(tmp_path / name) for name in ("a/run", "b/run", "other")]
    for folder in folders:
        RunFolder.create(Path(folder), TrainConfig())
    assert [run.name for run in read_runs(folders)] == [*folders[:2], "other"]


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ([], ["nothing to report on", "run folder"]),
        (["nowhere"], ["nowhere", "holds no run"]),
        (["pretrained:nobody"], ["pretrained:nobody", "no such policy"]),
        (["nowhere", "--out", "page.htm"], ["--out", "page.htm", ".html"]),
        (["nowhere", "--out", "no/such/page.html"], ["--out", "existing folder"]),
        (["nowhere", "--out", "/proc/page.html"], ["/proc/page.html", "cannot be written"]),
        (["RUN", "--maps", "nowhere"], ["nowhere", "maze"]),
        (["RUN", "RUN"], ["the same training seed twice"]),
        (["RUN", "--episodes", "0"], ["episodes", "0", "at least 1"]),
        (["RUN", "--tasks", "all"], ["--tasks", "points", "pairs"]),
        (["RUN", "--epsilon", "2"], ["epsilon is 2.0", "at most 1"]),
        (["RUN", "--params", "target"], ["--params target", "has no target"]),
    ],
)
def test_wrong_words_of_report_are_named_in_one_line(
    capsys: pytest.CaptureFixture[str],
    run_dir: Path,
    tmp_path: Path,
    words: list[str],
    names: list[str],
) -> None:
    capsys.readouterr()
    out = [] if "--out" in words else ["--out", str(tmp_path / "page.html")]
    assert main(["report", *[str(run_dir) if w == "RUN" else w for w in words], *out]) == 2
    stderr = capsys.readouterr().err
    assert stderr.startswith("sqn: ")
    assert stderr.count("\n") == 1, stderr
    for name in names:
        assert name in stderr, (name, stderr)
    assert list(tmp_path.iterdir()) == []
