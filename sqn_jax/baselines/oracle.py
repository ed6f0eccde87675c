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

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sqn_jax.baselines.beam import Beam, trace_back
from sqn_jax.baselines.shortest_paths import ShortestPaths, wrapped_once
from sqn_jax.config import EnvConfig
from sqn_jax.env import EnvParams
from sqn_jax.env.geometry import wrap_angle
from sqn_jax.env.navigation import BACKWARD, FORWARD, LEFT, RIGHT, STAND
from sqn_jax.maps import OccupancyMap, traversable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOVES = [FORWARD, BACKWARD, LEFT, RIGHT]
INVERSE = np.array([-1, BACKWARD, FORWARD, RIGHT, LEFT])
NOWHERE = np.iinfo(np.int64).max
LARGEST_ESTIMATE = 1e6
"""Steps; where no path leads to the goal, they would be infinitely many."""

BEAM = 100
"""Poses per episode and step while the whole path is planned."""
REPAIR_BEAM = 40
REPAIR_STEPS = 14
"""Size of the search after a step that led elsewhere than planned."""
ON_PLAN = 1e-3
"""A pose this near to the planned one, m and rad, is the planned one."""
ROBOTS_AT_ONCE = 50
"""Robots whose plans are searched together, by one of the processor's cores."""
SIDE_MARGIN = 1e-3
"""m that a planned move keeps from obstacles, so that float32 in the simulator agrees."""


class Oracle:
    """Plans for E robots, each with its own goal, and keeps the plans while they hold."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats) -> None:
        """Goals [E, 2] m; nothing is searched before it is needed."""
        _require_plannable(occupancy_map, env_params)
        self._world = occupancy_map, env_params
        self.goals = goals
        self.goal_radius = float(env_params.goal_radius)
        self.repairs = env_params.config.velocity_noise > 0
        self.arrived = np.zeros(len(goals), dtype=bool)
        self.step = 0
        self.max_steps = env_params.max_steps
        self.actions = np.full((len(goals), self.max_steps), STAND, np.int8)
        """What is planned for each step of the episode."""
        self.planned = np.full((len(goals), self.max_steps, 3), np.nan, np.float32)
        """Where the robots are before each of these actions; NaN where nothing is planned."""
        self.before: tuple[Floats, Ints] | None = None

    @cached_property
    def search(self) -> BeamSearch:
        """What plans. A goal that occurs twice is computed once."""
        return BeamSearch(*self._world, self.goals)

    def plans(self, poses: Floats) -> dict[str, NDArray[Any]]:
        """Plan from the first poses [E, 3], which `choose` will get: beside other work, say.

        Returns:
            `actions` [E, T'] of each step until the last robot has arrived, and `planned`
            [E, T', 3], where the robots are before it: what `follow` takes.
        """
        self._plan(np.arange(len(poses)), poses)
        length = int(np.isfinite(self.planned[..., 0]).any(axis=0).sum())
        return {"actions": self.actions[:, :length], "planned": self.planned[:, :length]}

    def follow(self, actions: NDArray[np.int8], planned: NDArray[np.float32]) -> None:
        """Go by what `plans` has returned for the same robots, maybe of another oracle."""
        self.actions[:, : actions.shape[1]] = actions
        self.planned[:, : actions.shape[1]] = planned

    def choose(self, poses: Floats) -> Ints:
        """Actions [E] for the robots at poses [E, 3]; one that has arrived stands still."""
        self.arrived |= np.hypot(*(poses[:, :2] - self.goals).T) < self.goal_radius
        if self.before is not None and not self.repairs:
            self._note_refusals(poses, *self.before)
        lost = np.flatnonzero(~self.arrived & ~_is_at(poses, self.planned[:, self.step]))
        if lost.size:
            self._plan(lost, poses[lost])
        chosen = np.where(self.arrived, STAND, self.actions[:, self.step]).astype(np.int64)
        self.step += 1
        self.before = poses, chosen
        return chosen

    def outlook(self) -> NDArray[np.int8]:
        """Actions [E, T'] of all steps to come, if everything goes as planned."""
        return np.where(self.arrived[:, None], np.int8(STAND), self.actions[:, self.step :])

    def _note_refusals(self, poses: Floats, before: Floats, taken: Ints) -> None:
        """Moves that the simulator has refused, so that no plan contains them again."""
        stood = (poses[:, :2] == before[:, :2]).all(axis=1)
        for i in np.flatnonzero(stood & np.isin(taken, (FORWARD, BACKWARD))):
            self.search.refused.append((int(i), before[i], int(taken[i])))

    def _plan(self, robots: Ints, poses: Floats) -> None:
        """Whole paths, with a wider beam if need be; under noise repaired, except the first."""
        steps = self.max_steps - self.step
        attempts = [(BEAM, steps), (4 * BEAM, steps)]
        if self.repairs and self.before is not None:
            attempts = [(REPAIR_BEAM, min(REPAIR_STEPS, steps))]
        for width, most in attempts:
            plans = self.search.plan(robots, poses, steps=most, width=width)
            for robot, (actions, planned, _) in zip(robots, plans, strict=True):
                end = self.step + len(actions)
                self.actions[robot, self.step : end] = actions
                self.planned[robot, self.step : end] = planned
                self.actions[robot, end:], self.planned[robot, end:] = STAND, np.nan
            failed = np.array([not reached for _, _, reached in plans])
            robots, poses = robots[failed], poses[failed]
            if not robots.size:
                return


def _require_plannable(occupancy_map: OccupancyMap, env_params: EnvParams) -> None:
    config = env_params.config
    if occupancy_map.shape != env_params.body.shape:
        raise ValueError(
            f"map {occupancy_map.name!r} has {occupancy_map.shape} cells, "
            f"expected {env_params.body.shape} as in env_params"
        )
    require_mobile(config)


def require_mobile(config: EnvConfig) -> None:
    """Refuse a robot that the oracle cannot plan for.

    Raises:
        ValueError: one line: it cannot move both ways and turn.
    """
    if min(config.forward_speed, config.backward_speed, config.turn_rate) <= 0:
        raise ValueError(
            "the robot cannot move or turn, expected speeds above 0 (or --no-baselines)"
        )


class BeamSearch:
    """Searches forward from given poses toward given goals, for many robots at once."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams, goals: Floats) -> None:
        config = env_params.config
        self.forward = config.forward_speed * config.time_step
        self.backward = config.backward_speed * config.time_step
        self.turn = config.turn_rate * config.time_step
        self.headings = max(1, round(2 * np.pi / self.turn))
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
        parts = np.array_split(np.arange(len(robots)), -(-len(robots) // ROBOTS_AT_ONCE))
        with ThreadPoolExecutor(os.cpu_count()) as threads:  # NumPy lets others run meanwhile.
            plans = threads.map(
                lambda part: self._plan_some(robots[part], poses[part], steps, width), parts
            )
            return [plan for of_part in plans for plan in of_part]

    def _plan_some(
        self, robots: Ints, poses: Floats, steps: int, width: int
    ) -> list[tuple[Ints, Floats, bool]]:
        """`plan` for few enough robots that their beams stay in the processor's caches."""
        beam = self._start(poses)
        searching = np.arange(len(robots))  # Whose rows the beam has.
        beams = [(searching, beam)]
        reached = np.zeros(len(robots), bool)
        for _ in range(steps):
            following = self._expand(beam, robots[searching])
            left, inside = self._steps_left(following, robots[searching])
            best, valid = self._select(following, left, width)
            rows = np.arange(len(searching))[:, None]
            beam = Beam._make(each[..., rows, best] for each in following)._replace(valid=valid)
            beams.append((searching, beam))
            arrived = inside[rows[:, 0], best[:, 0]]
            reached[searching[arrived]] = True
            if arrived.all():
                break
            if arrived.any():
                searching = searching[~arrived]
                beam = Beam._make(
                    each[:, ~arrived] if each.ndim == 3 else each[~arrived] for each in beam
                )
        return [
            (*trace_back(beams, robot), bool(is_there)) for robot, is_there in enumerate(reached)
        ]

    def _start(self, poses: Floats) -> Beam:
        zeros = np.zeros((len(poses), 1), np.int64)
        return Beam(
            parent=zeros,
            action=zeros.astype(np.int8),
            pose=poses.T[..., None],
            turns=zeros,
            cell=self.paths.cells_of(poses.T[:2, :, None]),
            valid=zeros == 0,
        )

    def _expand(self, beam: Beam, robots: Ints) -> Beam:
        """All poses one step on from those of a beam; no step straight back.

        Args:
            beam: where to go on from.
            robots: [N] which of the goals its robots have.
        """
        num_robots, width = beam.cell.shape
        heading = beam.pose[2]
        shape = (num_robots, len(MOVES), width)
        valid = beam.valid[:, None] & (beam.action[:, None] != INVERSE[MOVES, None])
        pose: Floats = np.broadcast_to(beam.pose[:, :, None], (3, *shape)).copy()
        turns, cell = (
            np.broadcast_to(each[:, None], shape).copy() for each in (beam.turns, beam.cell)
        )
        cosine, sine = np.cos(heading), np.sin(heading)
        for number, step in enumerate((self.forward, -self.backward)):
            pose[0, :, number] += step * cosine
            pose[1, :, number] += step * sine
            ahead = cosine * np.sign(step), sine * np.sign(step)
            tried = valid[:, number]
            tried &= self._is_clear(beam.pose[0], beam.pose[1], *ahead, abs(step), tried)
            reached = self.paths.cells_of(pose[:2, :, number])
            cell[:, number] = np.where(tried, reached, beam.cell)
        for number, sign in ((2, 1), (3, -1)):
            pose[2, :, number] = wrapped_once(heading + sign * self.turn)
            turns[:, number] = (beam.turns + sign) % self.headings
        for robot, refused_at, action in self.refused:
            row = np.flatnonzero(robots == robot)
            same = _is_at(np.moveaxis(beam.pose[:, row], 0, -1), refused_at)
            valid[row, MOVES.index(action)] &= ~same
        everyone = (num_robots, len(MOVES) * width)
        return Beam(
            parent=np.broadcast_to(np.tile(np.arange(width), len(MOVES)), everyone),
            action=np.broadcast_to(np.repeat(np.array(MOVES, np.int8), width), everyone),
            pose=pose.reshape(3, *everyone),
            turns=turns.reshape(everyone),
            cell=cell.reshape(everyone),
            valid=valid.reshape(everyone),
        )

    def _steps_left(self, beam: Beam, robots: Ints) -> tuple[Floats, NDArray[np.bool_]]:
        """Estimated steps to the goal, less than all others at the goal, and who is there."""
        robots = robots[:, None]
        left = self.paths.steps_left_in(beam.cell, robots, beam.pose, self.forward, self.backward)
        goals = self.goals[robots]
        away = np.hypot(beam.pose[0] - goals[..., 0], beam.pose[1] - goals[..., 1])
        # The tenth of a millimeter is for the simulator's single precision.
        inside = beam.valid & (away < self.goal_radius - 1e-4)
        left[inside] = -1.0
        return left, inside

    def _select(
        self, beam: Beam, left: Floats, width: int
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The `width` best poses of each robot, best first, one for each cell and heading.

        Integers are sorted in which the number of a pose stands last: several times faster than to
        sort numbers by the values of others.

        Returns:
            [N, P] where they are in the rows, and which of them are valid.
        """
        count = left.shape[1]
        bits = count.bit_length()
        last, places = (1 << bits) - 1, np.arange(count)
        most = np.fmin(left, LARGEST_ESTIMATE)
        fine = 2.0 ** (62 - bits) / (max(most.max(), 1.0) + 2.0)
        key = (((most + 1.0) * fine).astype(np.int64) << bits) + places
        key[~beam.valid] = NOWHERE
        key.sort(axis=1)
        valid = key != NOWHERE
        order = np.where(valid, key & last, 0)
        state = np.take_along_axis(beam.cell * self.headings + beam.turns, order, axis=1)
        key = (state << bits) + places
        key[~valid] = NOWHERE
        key.sort(axis=1)
        rank = key & last
        rank[:, 1:][key[:, 1:] >> bits == key[:, :-1] >> bits] = last
        rank.sort(axis=1)
        rank = rank[:, :width]
        valid = rank < last
        return np.take_along_axis(order, np.where(valid, rank, 0), axis=1), valid

    def is_clear(self, pose: Floats, distance: float) -> NDArray[np.bool_]:
        """Whether a straight move of `distance` m (< 0 is backward) from poses [N, 3] is allowed.

        Slightly stricter: two lines, `SIDE_MARGIN` to the left and right, must not meet a cell that
        is not free, and neither must the next millimeter.
        """
        x, y, heading = pose.T
        ahead = np.cos(heading) * np.sign(distance), np.sin(heading) * np.sign(distance)
        return self._is_clear(x, y, *ahead, abs(distance), np.ones(len(pose), bool))

    def _is_clear(
        self,
        x: Floats,
        y: Floats,
        ahead_x: Floats,
        ahead_y: Floats,
        distance: float,
        tried: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """`is_clear` from places, m, along unit vectors, arrays of any shape; where it is tried."""
        length = distance + 1e-3
        height, width = self.free.shape
        col = np.floor((x + ahead_x * (length / 2)) / self.resolution).astype(np.int64)
        row = np.floor((y + ahead_y * (length / 2)) / self.resolution).astype(np.int64)
        middle = np.clip(row, 0, height - 1) * width + np.clip(col, 0, width - 1)
        clear = self.clearance.reshape(-1)[middle] > length / 2 + SIDE_MARGIN
        near = np.nonzero(tried & ~clear)
        start = np.stack([x[near], y[near]], axis=-1)
        ahead = np.stack([ahead_x[near], ahead_y[near]], axis=-1)
        aside = SIDE_MARGIN * np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        free = self._line_is_free(start + aside, ahead * length)
        free[free] = self._line_is_free((start - aside)[free], ahead[free] * length)
        clear[near] = free
        return clear

    def _line_is_free(self, start: Floats, line: Floats) -> NDArray[np.bool_]:
        """Whether every cell that segments [N, 2] cross is free; beyond the border nothing is."""
        start, line = start / self.resolution, line / self.resolution
        # So far from within the map a line is beyond its border: what follows changes nothing.
        farthest = max(self.free.shape) + 1.0
        line = line / np.maximum(1.0, np.abs(line).max(axis=1, keepdims=True) / farthest)
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


def _is_at(pose: Floats, planned: NDArray[np.floating]) -> Any:
    """Whether poses [..., 3] are the planned ones [..., 3]."""
    away = pose - planned
    away[..., 2] = wrap_angle(away[..., 2])
    return np.abs(away).max(axis=-1) < ON_PLAN
