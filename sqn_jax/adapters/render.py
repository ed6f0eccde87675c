"""Pictures of an env: the map, what was seen of it, the scan, the robot and the goal."""

from __future__ import annotations

import math
import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from sqn_jax.env import EnvParams, EnvState
from sqn_jax.env.geometry import beam_angles
from sqn_jax.maps import OccupancyMap

SIZE = 480
"""Pixels of the longer side of a picture."""

FREE, SEEN, OBSTACLE = (247, 247, 244), (207, 227, 200), (51, 58, 66)
SCAN, ROBOT, GOAL, INK = (86, 180, 233), (230, 159, 0), (255, 217, 47), (34, 34, 34)

ROBOT_PX = 9
"""Least length of the robot's arrowhead from its center, pixels."""


DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
"""Variables of the environment by which SDL finds one on Linux."""


class Renderer:
    """Draws the states of one world; the map is prepared once."""

    def __init__(self, occupancy_map: OccupancyMap, env_params: EnvParams) -> None:
        self._occupied = occupancy_map.occupied
        self._resolution = occupancy_map.resolution
        self._tile_m = env_params.tile or occupancy_map.size_m
        self._config = env_params.config
        self._lattice = env_params.lattice
        width, height = self._tile_m
        self._scale = SIZE / max(width, height)
        self._columns, self._rows = (max(round(m * self._scale), 1) for m in (width, height))
        x = (np.arange(self._columns) + 0.5) / self._scale
        y = (np.arange(self._rows)[::-1] + 0.5) / self._scale
        self._x, self._y = np.minimum(x, width - 1e-6), np.clip(y, 0.0, height - 1e-6)
        points = (*self._lattice.shape, 32)
        nearest = self._lattice.nearest_point(*np.meshgrid(self._x, self._y))
        self._nearest = np.ravel_multi_index(nearest, points)

    def draw(self, state: EnvState, obs: NDArray[np.float32]) -> NDArray[np.uint8]:
        """The picture [h, w, 3] of a state, north up.

        Args:
            state: of one env, on the host. Of several maps side by side, its tile is shown.
            obs: [R + G], what the robot sees; its ranges are drawn, noise and all.
        """
        tile = np.array(self._tile_m)
        corner = np.floor(np.asarray(state.pose[:2]) / tile) * tile
        image = Image.fromarray(self._ground(state, corner), "RGB")
        draw = ImageDraw.Draw(image, "RGBA")
        x, y, heading = (float(value) for value in state.pose)
        position = np.array([x, y]) - corner
        angles = heading + beam_angles(self._config)
        reach = obs[: self._config.num_beams] * self._config.max_range
        ends = position + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        corners = self._pixels(np.concatenate([ends, position[None]]))
        draw.polygon(corners, fill=(*SCAN, 70), outline=SCAN)
        self._circle(draw, np.asarray(state.goal) - corner, self._config.goal_radius)
        size = max(ROBOT_PX / self._scale, self._config.robot_radius)
        outline = size * np.array([[1.3, 0.0], [-0.9, 0.9], [-0.45, 0.0], [-0.9, -0.9]])
        turn = np.array(
            [[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]
        )
        draw.polygon(self._pixels(outline @ turn + position), fill=ROBOT, outline=INK)
        return np.array(image)

    def _ground(self, state: EnvState, corner: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The map, with the area that was seen in another color."""
        rows = ((self._y + corner[1]) / self._resolution).astype(int)
        columns = ((self._x + corner[0]) / self._resolution).astype(int)
        occupied = self._occupied[rows][:, columns]
        bits = np.asarray(state.covered)[..., None] >> np.arange(32, dtype=np.uint32) & 1
        seen = bits.ravel()[self._nearest].astype(bool)
        ground = np.where(seen[..., None], SEEN, FREE)
        return np.where(occupied[..., None], OBSTACLE, ground).astype(np.uint8)

    def _circle(
        self, draw: ImageDraw.ImageDraw, center: NDArray[np.float64], radius_m: float
    ) -> None:
        ((x, y),) = self._pixels(center[None])
        radius = max(radius_m * self._scale, 4.0)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=GOAL, outline=INK)

    def _pixels(self, places: NDArray[np.float64]) -> list[tuple[float, float]]:
        """Places [P, 2] m in a tile as x and y in the picture."""
        return [(x * self._scale, self._rows - y * self._scale) for x, y in places.tolist()]


class Window:
    """A window on the screen, by pygame."""

    def __init__(self, frames_per_second: int) -> None:
        """Check that there can be one.

        Raises:
            ImportError: pygame is not installed.
            RuntimeError: there is no display.
        """
        try:
            import pygame
        except ImportError:
            raise ImportError(
                'render_mode is "human", which needs pygame: pip install pygame-ce'
            ) from None
        # Without a display SDL would draw where nobody sees it.
        if sys.platform == "linux" and not any(map(os.environ.get, DISPLAYS)):
            raise RuntimeError(
                f'render_mode is "human", expected a display: one of {", ".join(DISPLAYS)} is set'
            )
        self._pygame = pygame
        self._frames_per_second = frames_per_second
        try:
            pygame.display.init()
        except pygame.error as fault:
            raise RuntimeError(
                f'render_mode is "human", expected a display; pygame says: {fault}'
            ) from None
        self._screen: Any = None
        self._clock = pygame.time.Clock()

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture [h, w, 3], no sooner than the frame rate says."""
        pygame = self._pygame
        if self._screen is None:
            pygame.display.set_caption("sqn_jax")
            self._screen = pygame.display.set_mode(picture.shape[1::-1])
        pygame.event.pump()
        surface = pygame.surfarray.make_surface(picture.swapaxes(0, 1))
        self._screen.blit(surface, (0, 0))
        pygame.display.flip()
        self._clock.tick(self._frames_per_second)

    def close(self) -> None:
        """Close the window; a second time does nothing."""
        self._screen = None
        self._pygame.display.quit()
