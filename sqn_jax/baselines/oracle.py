"""The oracle: it knows the map and where it is, and gives the fewest time steps one can hope for.

How the oracle plans. A beam search goes forward from the robot's pose through the simulator's own
motions (forward, backward, turn; the real pose, nothing rounded; a move counts as possible if the
simulator would grant it). All poses in the beam have taken equally many steps, so they compete by
an estimate of what is left: the shortest path to the goal over the map, the turn toward that path,
and the bends along it. Without noise a plan holds to the end, but for the rare move that the
simulator's single precision refuses: it is then planned anew without that move. With noise on the
velocity a short search repairs the plan after each step. Beam search is not proven optimal: see
`tests/baselines/test_oracle.py` for how it stands to a full search on a lattice.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sqn_jax.baselines.shortest_paths import ShortestPaths
from sqn_jax.env import EnvParams
from sqn_jax.env.geometry import wrap_angle
from sqn_jax.env.navigation import BACKWARD, FORWARD, LEFT, RIGHT, STAND
from sqn_jax.maps import OccupancyMap, traversable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

INVERSE = np.array([-1, BACKWARD, FORWARD, RIGHT, LEFT])

BEAM = 100
"""Poses per episode and step while the whole path is planned."""
REPAIR_BEAM = 40
REPAIR_STEPS = 14
"""Size of the search after a step that led elsewhere than planned."""
ON_PLAN = 1e-3
"""A pose this near to the planned one, m and rad, is the planned one."""
SIDE_MARGIN = 1e-3
"""m that a planned move keeps from obstacles, so that float32 in the simulator agrees."""


class Oracle:
    """Plans for E robots, each with its own goal, and keeps the plans while they hold."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats) -> None:
        """Compute the paths to all goals [E, 2]; a goal that occurs twice is computed once."""
        self.search = BeamSearch(occupancy_map, env_params, goals)
        self.goals = goals
        self.steps_left = env_params.max_steps
        self.repairs = env_params.config.velocity_noise > 0
        self.arrived = np.zeros(len(goals), dtype=bool)
        self.actions: list[Ints] = [np.empty(0, np.int64)] * len(goals)
        self.planned: list[Floats] = [np.empty((0, 3))] * len(goals)
        self.before: tuple[Floats, Ints] | None = None

    def choose(self, poses: Floats) -> Ints:
        """Actions [E] for the robots at poses [E, 3]; one that has arrived stands still."""
        self.arrived |= np.hypot(*(poses[:, :2] - self.goals).T) < self.search.goal_radius
        if self.before is not None and not self.repairs:
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
        """Whole paths, with a wider beam if need be; under noise repaired, except the first."""
        attempts = [(BEAM, self.steps_left), (4 * BEAM, self.steps_left)]
        if self.repairs and self.before is not None:
            attempts = [(REPAIR_BEAM, min(REPAIR_STEPS, self.steps_left))]
        for width, steps in attempts:
            plans = self.search.plan(robots, poses, steps=steps, width=width)
            for robot, (actions, planned, _) in zip(robots, plans, strict=True):
                self.actions[robot], self.planned[robot] = actions, planned
            failed = np.array([not reached for _, _, reached in plans])
            robots, poses = robots[failed], poses[failed]
            if not robots.size:
                return


class _Beam(NamedTuple):
    """The poses [P] that the search continues from; all have taken equally many steps."""

    robot: Ints
    """Whose they are."""
    parent: Ints
    """Where in the beam before they came from."""
    action: Ints
    """What led here; `STAND` at the start."""
    pose: Floats
    """[P, 3] x, y, m, and heading, rad."""
    turns: Ints
    """Turns made so far, to the left less those to the right: the heading, without rounding."""

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> _Beam:
        """Copies of some of them, by number or by mask."""
        return _Beam._make(each[index] for each in self)


class BeamSearch:
    """Searches forward from given poses toward given goals, for many robots at once."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats) -> None:
        config = env_params.config
        if occupancy_map.shape != env_params.body.shape:
            raise ValueError(
                f"map {occupancy_map.name!r} has {occupancy_map.shape} cells, "
                f"expected {env_params.body.shape} as in env_params"
            )
        self.forward = config.forward_speed * config.time_step
        self.backward = config.backward_speed * config.time_step
        self.turn = config.turn_rate * config.time_step
        if min(self.forward, self.backward, self.turn) <= 0:
            raise ValueError("the robot cannot move or turn, expected speeds above 0")
        self.goal_radius = float(env_params.goal_radius)
        self.resolution = occupancy_map.resolution
        self.free = traversable(occupancy_map.occupied, self.resolution, config.robot_radius)
        # Distance in m from a point of a cell to cells that are not free, at least.
        self.clearance = (ndimage.distance_transform_edt(self.free) - np.sqrt(2)) * self.resolution
        self.goals = goals
        self.refused: list[tuple[int, Floats, int]] = []
        """Moves to leave out: robot, pose, action."""
        self.paths = ShortestPaths(self.free, self.resolution, goals, self.turn)

    def plan(
        self, robots: Ints, poses: Floats, *, steps: int, width: int
    ) -> list[tuple[Ints, Floats, bool]]:
        """Plan for some robots.

        Args:
            robots: [N] which of the goals each one has.
            poses: [N, 3] where they are.
            steps: how far ahead, at most.
            width: poses per robot and step.

        Returns:
            For each robot its actions [S], the poses [S, 3] before each of them, and whether they
            lead to the goal; if not, they lead to the best place within `steps`.
        """
        zeros = np.zeros(len(robots), np.int64)
        beam = _Beam(np.arange(len(robots)), zeros, zeros, poses, zeros)
        beams, alive = [beam], beam.robot
        ends = np.zeros((len(robots), 2), np.int64)
        reached = np.zeros(len(robots), bool)
        for depth in range(1, steps + 1):
            following = self._expand(beam.take(alive), alive)
            before = beam.pose[following.parent]
            following = following.take(
                self._allowed(robots[following.robot], before, following.action)
            )
            owner, pose = robots[following.robot], following.pose
            left = self.paths.steps_left(owner, pose, self.forward, self.backward)
            # The tenth of a millimeter is for the simulator's single precision.
            inside = np.hypot(*(pose[:, :2] - self.goals[owner]).T) < self.goal_radius - 1e-4
            left[inside] = -1.0
            best = self._select(following, left, width)
            beam = following.take(best)
            beams.append(beam)
            # The best pose of each robot comes first.
            own, first = np.unique(beam.robot, return_index=True)
            ends[own] = np.stack([np.full(len(own), depth), first], axis=-1)
            reached[own] = inside[best][first]
            alive = np.flatnonzero(~reached[beam.robot])
            if not alive.size:
                break
        return [
            (*_trace_back(beams, int(depth), int(index)), bool(is_there))
            for (depth, index), is_there in zip(ends, reached, strict=True)
        ]

    def _expand(self, beam: _Beam, numbers: Ints) -> _Beam:
        """All poses one step on from those of a beam; no step straight back.

        Args:
            beam: where to go on from.
            numbers: [P] what its poses are called as parents.
        """
        beam = beam._replace(parent=numbers)
        parts = []
        for action in (FORWARD, BACKWARD, LEFT, RIGHT):
            part = beam.take(beam.action != INVERSE[action])
            if action in (FORWARD, BACKWARD):
                step = self.forward if action == FORWARD else -self.backward
                part = part.take(self.is_clear(part.pose, step))
                heading = part.pose[:, 2]
                part.pose[:, 0] += step * np.cos(heading)
                part.pose[:, 1] += step * np.sin(heading)
            else:
                sign = 1 if action == LEFT else -1
                part.pose[:, 2] = wrap_angle(part.pose[:, 2] + sign * self.turn)
                part.turns[:] += sign
            part.action[:] = action
            parts.append(part)
        return _Beam._make(np.concatenate(each) for each in zip(*parts, strict=True))

    def _allowed(self, robots: Ints, before: Floats, action: Ints) -> NDArray[np.bool_]:
        """Which of the moves [N] were not refused before."""
        allowed = np.ones(len(robots), dtype=bool)
        for robot, pose, refused in self.refused:
            same = np.flatnonzero((robots == robot) & (action == refused))
            allowed[same[_is_at(before[same], pose)]] = False
        return allowed

    def _select(self, beam: _Beam, left: Floats, width: int) -> NDArray[np.intp]:
        """The `width` best poses of each robot, best first, one for each cell and heading."""
        headings = max(1, round(2 * np.pi / self.turn))
        col, row = np.floor(beam.pose[:, :2] / self.resolution).astype(np.int64).T
        cell = row * self.free.shape[1] + col
        state = (beam.robot * self.free.size + cell) * headings + beam.turns % headings
        order = np.lexsort((left, beam.robot))
        first = np.sort(np.unique(state[order], return_index=True)[1])
        order = order[first]
        owner = beam.robot[order]
        rank = np.arange(len(order)) - np.searchsorted(owner, owner)
        return order[rank < width]

    def is_clear(self, pose: Floats, distance: float) -> NDArray[np.bool_]:
        """Whether a straight move of `distance` m (< 0 is backward) from poses [N, 3] is allowed.

        Slightly stricter: two lines, `SIDE_MARGIN` to the left and right, must not meet a cell that
        is not free, and neither must the next millimeter.
        """
        direction = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1) * np.sign(distance)
        length = abs(distance) + 1e-3
        col, row = (
            np.floor((pose[:, :2] + direction * (length / 2)) / self.resolution).astype(int).T
        )
        row = np.clip(row, 0, self.free.shape[0] - 1)
        col = np.clip(col, 0, self.free.shape[1] - 1)
        clear = self.clearance[row, col] > length / 2 + SIDE_MARGIN
        near = np.flatnonzero(~clear)
        start, ahead = pose[near, :2], direction[near]
        aside = SIDE_MARGIN * np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        clear[near] = self._line_is_free(start + aside, ahead * length)
        clear[near] &= self._line_is_free(start - aside, ahead * length)
        return clear

    def _line_is_free(self, start: Floats, line: Floats) -> NDArray[np.bool_]:
        """Whether every cell that segments [N, 2] cross is free; beyond the border nothing is."""
        start, line = start / self.resolution, line / self.resolution
        most = int(np.ceil(np.abs(line).max(initial=0.0))) + 1
        # Borders crossed, as fractions of the line; between two of them lies one cell.
        with np.errstate(divide="ignore", invalid="ignore"):
            upwards = line[..., None] > 0
            border = np.floor(start)[..., None] + np.where(
                upwards, np.arange(1, most + 1), -np.arange(most)
            )
            fractions = (border - start[..., None]) / line[..., None]
        fractions = np.where(line[..., None] == 0, 1.0, np.clip(fractions, 0.0, 1.0))
        ends = np.tile([0.0, 1.0], (len(start), 1))
        fractions = np.sort(
            np.concatenate([fractions.reshape(len(start), 2 * most), ends], axis=1), axis=1
        )
        middle = (fractions[:, 1:] + fractions[:, :-1]) / 2
        col = np.floor(start[:, :1] + line[:, :1] * middle).astype(np.int64)
        row = np.floor(start[:, 1:] + line[:, 1:] * middle).astype(np.int64)
        row = np.clip(row, 0, self.free.shape[0] - 1)
        col = np.clip(col, 0, self.free.shape[1] - 1)
        empty = fractions[:, 1:] - fractions[:, :-1] < 1e-12
        return np.asarray((self.free[row, col] | empty).all(axis=1))


def _is_at(pose: Floats, planned: Floats) -> Any:
    """Whether poses [..., 3] are a planned one [3]."""
    away = pose - planned
    away[..., 2] = wrap_angle(away[..., 2])
    return np.abs(away).max(axis=-1) < ON_PLAN


def _trace_back(beams: list[_Beam], depth: int, index: int) -> tuple[Ints, Floats]:
    """Actions and the poses before them that led to one pose of a beam."""
    actions, poses = [], []
    for beam, before in zip(beams[depth:0:-1], beams[:depth][::-1], strict=True):
        actions.append(beam.action[index])
        index = beam.parent[index]
        poses.append(before.pose[index])
    return np.array(actions[::-1], np.int64), np.array(poses[::-1]).reshape(-1, 3)
