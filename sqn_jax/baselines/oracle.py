"""The oracle: it knows the map and where it is, and gives the fewest time steps one can hope for.

How the oracle plans. A beam search goes forward from the robot's pose through the simulator's own
motions (drive, reverse, turn; the real pose, nothing rounded; a move counts as possible if the
simulator would grant it). All poses in the beam have taken equally many steps, so they compete by
an estimate of what is left: the shortest way to the goal over the map, the turn towards that way,
and the bends along it. Without noise a plan holds to the end, but for the rare move that the
simulator's single precision refuses: it is then planned anew without that move. With noise on the
velocity a short search mends the plan after each step. Beam search is not proven optimal: see
`tests/baselines/test_oracle.py` for how it stands to a full search on the lattice of
`shortest_paths.oracle_steps`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sqn_jax.baselines.shortest_paths import Ways
from sqn_jax.env import EnvParams
from sqn_jax.env.geometry import wrap_angle
from sqn_jax.env.navigation import BACKWARD, FORWARD, LEFT, RIGHT, STAND
from sqn_jax.maps import OccupancyMap, traversable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

INVERSE = np.array([-1, BACKWARD, FORWARD, RIGHT, LEFT])

BEAM = 100
"""Poses kept an episode and step while the whole way is planned."""
MENDING_BEAM = 40
MENDING_STEPS = 14
"""Size of the search after a step that led elsewhere than planned."""
ON_PLAN = 1e-3
"""A pose this near to the planned one, m and rad, is the planned one."""
SIDE_ROOM = 1e-3
"""m that a planned move keeps from obstacles, so that float32 in the simulator agrees."""


class Oracle:
    """Plans for E robots, each with its own goal, and keeps the plans while they hold."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats) -> None:
        """Compute the ways to all goals [E, 2]; a goal that occurs twice is computed once."""
        self.search = BeamSearch(occupancy_map, env_params, goals)
        self.goals = goals
        self.steps_left = env_params.max_steps
        self.mends = env_params.config.velocity_noise > 0
        self.arrived = np.zeros(len(goals), dtype=bool)
        self.actions: list[Ints] = [np.empty(0, np.int64)] * len(goals)
        self.planned: list[Floats] = [np.empty((0, 3))] * len(goals)
        self.before: tuple[Floats, Ints] | None = None

    def choose(self, poses: Floats) -> Ints:
        """Actions [E] for the robots at poses [E, 3]; one that has arrived stands still."""
        self.arrived |= np.hypot(*(poses[:, :2] - self.goals).T) < self.search.goal_radius
        if self.before is not None and not self.mends:
            self._note_refusals(poses, *self.before)
        lost = [i for i in np.flatnonzero(~self.arrived) if not self._is_on_plan(int(i), poses[i])]
        if lost:
            self._plan(np.array(lost), poses[lost])
        chosen = np.full(len(poses), STAND)
        for i in np.flatnonzero(~self.arrived):
            if len(self.actions[i]):
                chosen[i] = self.actions[i][0]
                self.actions[i], self.planned[i] = self.actions[i][1:], self.planned[i][1:]
        self.steps_left -= 1
        self.before = poses, chosen
        return chosen

    def _note_refusals(self, poses: Floats, before: Floats, taken: Ints) -> None:
        """Moves that the simulator has refused, so that no plan contains them again."""
        stood = (poses[:, :2] == before[:, :2]).all(axis=1)
        for i in np.flatnonzero(stood & np.isin(taken, (FORWARD, BACKWARD))):
            self.search.refused.append((int(i), before[i], int(taken[i])))

    def _is_on_plan(self, robot: int, pose: Floats) -> bool:
        return len(self.actions[robot]) > 0 and bool(_is_at(pose, self.planned[robot][0]))

    def _plan(self, robots: Ints, poses: Floats) -> None:
        """Whole ways, with a wider beam if need be; mending ones under noise, but for the first."""
        attempts = [(BEAM, self.steps_left), (4 * BEAM, self.steps_left)]
        if self.mends and self.before is not None:
            attempts = [(MENDING_BEAM, min(MENDING_STEPS, self.steps_left))]
        for width, steps in attempts:
            plans = self.search.plan(robots, poses, steps=steps, width=width)
            for robot, (actions, planned, _) in zip(robots, plans, strict=True):
                self.actions[robot], self.planned[robot] = actions, planned
            failed = np.array([not found for _, _, found in plans])
            robots, poses = robots[failed], poses[failed]
            if not robots.size:
                return


class BeamSearch:
    """Searches forward from given poses towards given goals, for many robots at once."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats) -> None:
        config = env_params.config
        shape = (env_params.body.height, env_params.body.width)
        if occupancy_map.shape != shape:
            raise ValueError(
                f"map {occupancy_map.name!r} has {occupancy_map.shape} cells, "
                f"expected {shape} as in env_params"
            )
        self.forward = config.forward_speed * config.time_step
        self.backward = config.backward_speed * config.time_step
        self.turn = config.turn_rate * config.time_step
        if min(self.forward, self.backward, self.turn) <= 0:
            raise ValueError("the robot cannot drive or turn, expected speeds above 0")
        self.goal_radius = float(env_params.goal_radius)
        self.resolution = occupancy_map.resolution
        self.free = traversable(occupancy_map.occupied, self.resolution, config.robot_radius)
        # Distance in m from a point of a cell to cells that are not free, at least.
        self.room = (ndimage.distance_transform_edt(self.free) - np.sqrt(2)) * self.resolution
        self.goals = goals
        self.refused: list[tuple[int, Floats, int]] = []
        """Moves to leave out: robot, pose, action."""
        self.ways = Ways(self.free, self.resolution, goals, self.turn)

    def plan(
        self, robots: Ints, poses: Floats, *, steps: int, width: int
    ) -> list[tuple[Ints, Floats, bool]]:
        """Plan for some robots.

        Args:
            robots: [N] which of the goals each one has.
            poses: [N, 3] where they are.
            steps: how far ahead, at most.
            width: poses kept a robot and step.

        Returns:
            For each robot its actions [S], the poses [S, 3] before each of them, and whether they
            lead to the goal; if not, they lead to the best place within `steps`.
        """
        who, pose = np.arange(len(robots)), poses
        last = turned = np.zeros(len(robots), np.int64)
        alive = who
        layers = [(who, last, pose)]
        ends = np.zeros((len(robots), 2), np.int64)
        reached = np.zeros(len(robots), bool)
        for depth in range(1, steps + 1):
            parent, last, pose, turned = self._expand(alive, last, pose, turned)
            who = who[parent]
            allowed = self._allowed(robots[who], layers[-1][2][parent], last)
            who, parent, last = who[allowed], parent[allowed], last[allowed]
            pose, turned = pose[allowed], turned[allowed]
            goals = self.goals[robots[who]]
            left = self.ways.steps_left(robots[who], pose, self.forward, self.backward)
            # The tenth of a millimetre is for the simulator's single precision.
            inside = np.hypot(*(pose[:, :2] - goals).T) < self.goal_radius - 1e-4
            left[inside] = -1.0
            kept = self._select(who, pose, turned, left, width)
            who, last, pose, turned = who[kept], last[kept], pose[kept], turned[kept]
            layers.append((parent[kept], last, pose))
            # The best pose of each robot comes first.
            own, best = np.unique(who, return_index=True)
            ends[own] = np.stack([np.full(len(own), depth), best], axis=-1)
            reached[own] = inside[kept][best]
            alive = np.flatnonzero(~reached[who])
            if not alive.size:
                break
        return [
            (*_trace_back(layers, int(depth), int(best)), bool(found))
            for (depth, best), found in zip(ends, reached, strict=True)
        ]

    def _expand(
        self, alive: Ints, last: Ints, pose: Floats, turned: Ints
    ) -> tuple[Ints, Ints, Floats, Ints]:
        """All poses one step on: parent, action, pose and turns made; no step straight back."""
        parts = []
        for action in (FORWARD, BACKWARD, LEFT, RIGHT):
            parent = alive[last[alive] != INVERSE[action]]
            new, turns = pose[parent], turned[parent]
            if action in (FORWARD, BACKWARD):
                way = self.forward if action == FORWARD else -self.backward
                possible = self.is_clear(new, way)
                parent, new, turns = parent[possible], new[possible], turns[possible]
                new[:, 0] += way * np.cos(new[:, 2])
                new[:, 1] += way * np.sin(new[:, 2])
            else:
                sign = 1 if action == LEFT else -1
                new[:, 2] = wrap_angle(new[:, 2] + sign * self.turn)
                turns = turns + sign
            parts.append((parent, np.full(len(parent), action), new, turns))
        parent, taken, new, turns = (np.concatenate(p) for p in zip(*parts, strict=True))
        return parent, taken, new, turns

    def _allowed(self, robots: Ints, before: Floats, action: Ints) -> NDArray[np.bool_]:
        """Which of the moves [N] were not refused before."""
        allowed = np.ones(len(robots), dtype=bool)
        for robot, pose, refused in self.refused:
            same = np.flatnonzero((robots == robot) & (action == refused))
            allowed[same[_is_at(before[same], pose)]] = False
        return allowed

    def _select(
        self, who: Ints, pose: Floats, turned: Ints, left: Floats, width: int
    ) -> NDArray[np.intp]:
        """The `width` best poses of each robot, best first, one for each cell and heading."""
        headings = max(1, round(2 * np.pi / self.turn))
        col, row = np.floor(pose[:, :2] / self.resolution).astype(np.int64).T
        cell = row * self.free.shape[1] + col
        state = (who * self.free.size + cell) * headings + turned % headings
        order = np.lexsort((left, who))
        first = np.sort(np.unique(state[order], return_index=True)[1])
        order = order[first]
        owner = who[order]
        rank = np.arange(len(order)) - np.searchsorted(owner, owner)
        return order[rank < width]

    def is_clear(self, pose: Floats, way: float) -> NDArray[np.bool_]:
        """Whether the simulator grants a straight move from poses [N, 3] by `way` m, negative back.

        Slightly stricter: two lines, `SIDE_ROOM` to the left and right, must not meet a cell that
        is not free, and neither must the next millimetre.
        """
        direction = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1) * np.sign(way)
        length = abs(way) + 1e-3
        col, row = (
            np.floor((pose[:, :2] + direction * (length / 2)) / self.resolution).astype(int).T
        )
        row = np.clip(row, 0, self.free.shape[0] - 1)
        col = np.clip(col, 0, self.free.shape[1] - 1)
        clear = self.room[row, col] > length / 2 + SIDE_ROOM
        near = np.flatnonzero(~clear)
        start, ahead = pose[near, :2], direction[near]
        aside = SIDE_ROOM * np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        clear[near] = self._line_is_free(start + aside, ahead * length)
        clear[near] &= self._line_is_free(start - aside, ahead * length)
        return clear

    def _line_is_free(self, start: Floats, way: Floats) -> NDArray[np.bool_]:
        """Whether every cell that segments [N, 2] cross is free; beyond the border nothing is."""
        start, way = start / self.resolution, way / self.resolution
        most = int(np.ceil(np.abs(way).max(initial=0.0))) + 1
        # Borders crossed, as shares of the way; between two of them lies one cell.
        with np.errstate(divide="ignore", invalid="ignore"):
            upwards = way[..., None] > 0
            border = np.floor(start)[..., None] + np.where(
                upwards, np.arange(1, most + 1), -np.arange(most)
            )
            shares = (border - start[..., None]) / way[..., None]
        shares = np.where(way[..., None] == 0, 1.0, np.clip(shares, 0.0, 1.0))
        ends = np.tile([0.0, 1.0], (len(start), 1))
        shares = np.sort(
            np.concatenate([shares.reshape(len(start), 2 * most), ends], axis=1), axis=1
        )
        middle = (shares[:, 1:] + shares[:, :-1]) / 2
        col = np.floor(start[:, :1] + way[:, :1] * middle).astype(np.int64)
        row = np.floor(start[:, 1:] + way[:, 1:] * middle).astype(np.int64)
        row = np.clip(row, 0, self.free.shape[0] - 1)
        col = np.clip(col, 0, self.free.shape[1] - 1)
        empty = shares[:, 1:] - shares[:, :-1] < 1e-12
        return np.asarray((self.free[row, col] | empty).all(axis=1))


def _is_at(pose: Floats, planned: Floats) -> Any:
    """Whether poses [..., 3] are a planned one [3]."""
    away = pose - planned
    away[..., 2] = wrap_angle(away[..., 2])
    return np.abs(away).max(axis=-1) < ON_PLAN


def _trace_back(
    layers: list[tuple[Ints, Ints, Floats]], depth: int, index: int
) -> tuple[Ints, Floats]:
    """Actions and the poses before them that led to one pose of a beam."""
    actions, poses = [], []
    for parents, taken, _ in layers[depth:0:-1]:
        depth -= 1
        actions.append(taken[index])
        index = parents[index]
        poses.append(layers[depth][2][index])
    return np.array(actions[::-1], np.int64), np.array(poses[::-1]).reshape(-1, 3)
