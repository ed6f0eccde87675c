/**
 * Shortest paths for the robot's center, as `sqn_jax/maps/distance.py` measures them: over the centers of
 * free cells by moves of up to 3 cells across and up, which touch no blocked cell.
 */

/**
 * @param {Grid} grid
 * @param {Uint8Array} blocked from `grid.blockedFor(radius)`
 * @param {number[]} from x m, y m
 * @param {number[]} to x m, y m
 * @returns {{length: number, points: number[][]} | null} m from the center of the first cell to the goal,
 *   and the corners of the path [x m, y m] from start to goal; null where there is none
 */
export function shortestPath(grid, blocked, from, to) {
  throw new Error('to come');
}
