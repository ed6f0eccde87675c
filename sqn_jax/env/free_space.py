"""The table that makes exact ray casting cheap: free rectangles, one per cell and direction.

For each cell and each sector of directions the table holds the width and height, in cells, of an
empty rectangle that has the cell in one corner and reaches out toward the sector. A ray that
starts anywhere in the cell may go straight to the rectangle's far side without a look at the
cells between, and the place where it leaves is known to floating-point accuracy. A grid traversal
needs a hundred steps for 5 m of 5 cm cells; hopping from rectangle to rectangle needs about four.

Few sectors with well-chosen rectangles need no more hops than many, and a table that is small is
what makes a hop fast. Built on the host with NumPy, once for a map: 2 bytes x sectors x cells, 2 MB
for 340 x 340.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

SLOPES = 8
"""Slopes in a quadrant along which rectangles are looked for."""

CELLS_AT_ONCE = 2**14
"""Cells whose rectangles are looked for together: few enough for the processor's caches."""


def table(blocked: NDArray[np.bool_], sectors: int, reach: int) -> NDArray[np.int16]:
    """The table that a ray reads, [sectors, H, W]: `far_sides` of `free_rectangles`."""
    return far_sides(free_rectangles(blocked, sectors, reach))


def free_rectangles(blocked: NDArray[np.bool_], sectors: int, reach: int) -> NDArray[np.uint16]:
    """Build the table.

    Args:
        blocked: [H, W] cells a ray cannot enter; the border must be blocked.
        sectors: directions distinguished, a multiple of 4; sector s covers the angles
            2 pi [s, s + 1) / sectors, counted from +x toward +y (increasing row).
        reach: longest rectangle along the direction, cells, at most 250.

    Returns:
        [sectors, H, W], width + 256 * height; 0 in blocked cells, at least 1 x 1 in free ones.

    Raises:
        ValueError: `sectors` is not a multiple of 4, `reach` is out of range, or the border is
            open, so that a ray could leave the map.
    """
    if sectors < 4 or sectors % 4:
        raise ValueError(f"sectors is {sectors}, expected a positive multiple of 4")
    if not 1 <= reach <= 250:
        raise ValueError(f"reach is {reach} cells, expected 1 to 250")
    border = (blocked[0], blocked[-1], blocked[:, 0], blocked[:, -1])
    if not all(edge.all() for edge in border):
        raise ValueError("the border of the map is open, expected it to be blocked")
    per_quadrant = sectors // 4
    table = np.empty((sectors, *blocked.shape), np.uint16)
    for quadrant, (step_y, step_x) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
        # Mirror the map so that the quadrant looks toward +x, +y, and mirror the result back.
        mirrored = _Sums(blocked[::step_y, ::step_x], reach)
        for offset in range(per_quadrant):
            # In quadrants 1 and 3 the mirror image runs through the angles backwards.
            position = per_quadrant - 1 - offset if quadrant % 2 else offset
            width = np.pi / 2 / per_quadrant
            rectangles = mirrored.largest_free(position * width, (position + 1) * width)
            table[quadrant * per_quadrant + offset] = rectangles[::step_y, ::step_x]
    return table


def far_sides(rectangles: NDArray[np.uint16]) -> NDArray[np.int16]:
    """The rectangles as a ray wants them: their far sides, counted from the cell's lower left.

    Args:
        rectangles: [sectors, H, W] from `free_rectangles`, none longer than 127 cells.

    Returns:
        [sectors, H, W]; the lower byte is the column of the far side less that of the cell, the
        upper byte the same for rows, both signed. A blocked cell has its near sides there, so that
        a ray that has come in gets no farther.
    """
    sectors = len(rectangles)
    middle = (np.arange(sectors) + 0.5) * (2 * np.pi / sectors)
    sides = np.empty(rectangles.shape, np.int16)
    for sector, angle in enumerate(middle):
        width, height = (rectangles[sector] & 255, rectangles[sector] >> 8)
        columns = width if np.cos(angle) > 0 else 1 - width
        rows = height if np.sin(angle) > 0 else 1 - height
        sides[sector] = ((columns & 255) | (rows << 8)).view(np.int16)
    return sides


class _Sums:
    """Summed-area table of a blocked map, padded with blocked cells beyond the far sides.

    Rectangles are looked for from the F free cells only, which in a cave are few.
    """

    def __init__(self, blocked: NDArray[np.bool_], reach: int) -> None:
        self.free = ~blocked
        self.reach = reach
        height, width = blocked.shape
        padded = np.ones((height + reach + 2, width + reach + 2), np.int32)
        padded[:height, :width] = blocked
        sums = np.zeros((padded.shape[0] + 1, padded.shape[1] + 1), np.int32)
        np.cumsum(np.cumsum(padded, axis=0), axis=1, out=sums[1:, 1:])
        rows, columns = np.nonzero(self.free)
        self.stride = sums.shape[1]
        self.sums = sums.reshape(-1)
        self.corners = rows * self.stride + columns
        self.run_x = np.minimum(_run(blocked)[self.free], reach)
        self.run_y = np.minimum(_run(blocked.T).T[self.free], reach)

    def largest_free(self, first: float, last: float) -> NDArray[np.uint16]:
        """The free rectangle from each cell toward +x, +y that takes rays the farthest.

        On average over three slopes between `first` and `last`, rad.
        """
        spread = (last - first) * np.array([1, 3, 5]) / 6 + first
        per_cell_x = (1 / np.cos(spread)).astype(np.float32)
        per_cell_y = (1 / np.sin(spread)).astype(np.float32)
        farthest = np.zeros(self.corners.shape, np.float32)
        best = np.zeros(self.corners.shape, np.uint16)
        for width, height in self._candidates(first, last):
            wide, high = np.float32(width), np.float32(height)
            advance = sum(
                np.minimum(wide * x, high * y) for x, y in zip(per_cell_x, per_cell_y, strict=True)
            )
            better = advance > farthest
            np.copyto(farthest, advance, where=better)
            np.copyto(best, np.uint16(width) | np.uint16(height) << 8, where=better)
        table = np.zeros(self.free.shape, np.uint16)
        table[self.free] = best
        return table

    def _candidates(self, first: float, last: float) -> Iterator[tuple[Any, Any]]:
        """Widths and heights of free rectangles.

        Along slopes with room to spare, since rays start anywhere in the cell, and strips of one
        cell's width, which are all there is beside a wall.
        """
        yield self.run_x, 1
        yield 1, self.run_y
        lengths = np.arange(self.reach + 1)
        slack = (lengths > 2).astype(np.int32)
        one = (lengths > 0).astype(np.int32)
        count = math.ceil(SLOPES * (last - first) / (np.pi / 2) - 1e-9)
        for slope in first + (last - first) * (np.arange(count) + 0.5) / count:
            along_x = np.maximum(np.ceil(lengths * np.cos(slope)).astype(np.int32) + slack, one)
            along_y = np.maximum(np.ceil(lengths * np.sin(slope)).astype(np.int32) + slack, one)
            yield self._longest(along_x, along_y)

    def _longest(
        self, widths: NDArray[np.int32], heights: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Width and height [F] of the last free one of nested candidates, by binary search."""
        ups, rights = heights.astype(np.intp) * self.stride, widths.astype(np.intp)
        corners = ups + rights
        longest = np.empty(self.corners.shape, np.intp)
        for first in range(0, len(longest), CELLS_AT_ONCE):
            cells = slice(first, first + CELLS_AT_ONCE)
            corner = self.corners[cells]
            before = self.sums.take(corner)
            free, blocked = np.zeros_like(corner), np.full_like(corner, self.reach + 1)
            for _ in range(self.reach.bit_length()):
                middle = (free + blocked) // 2
                total = self.sums.take(corner + corners.take(middle)) + before
                total -= self.sums.take(corner + rights.take(middle))
                total -= self.sums.take(corner + ups.take(middle))
                free = np.where(total == 0, middle, free)
                blocked = np.where(total == 0, blocked, middle)
            longest[cells] = free
        return widths[longest], heights[longest]


def _run(blocked: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Cells [H, W] from each cell on, itself among them, to the next blocked one along its row."""
    width = blocked.shape[1]
    columns = np.arange(width, dtype=np.int32)
    ends = np.where(blocked, columns, np.int32(width))[:, ::-1]
    return np.minimum.accumulate(ends, axis=1)[:, ::-1] - columns
