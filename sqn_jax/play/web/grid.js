/**
 * The occupancy grid. Cells are numbered row by row from the lower left corner: `row * width + column`.
 * Positions are in meters from that corner, x to the right and y upward.
 *
 * @typedef {object} MapData what `map_data.py` writes
 * @property {string} name
 * @property {number} width columns
 * @property {number} height rows
 * @property {number} resolution m per cell
 * @property {number[]} origin x m, y m, yaw rad of the lower left corner in the frame of its file
 * @property {string} cells base64 of one bit a cell, 1 where it is occupied, the first in the highest bit
 * @property {number[][]} spawn_points x m, y m each, here and below in the grid's frame
 * @property {number[][]} evaluation_points
 * @property {number} max_steps steps an episode
 */

export class Grid {
  /**
   * @param {number} width columns
   * @param {number} height rows
   * @param {number} resolution m per cell
   * @param {number[]} origin x m, y m, yaw rad
   * @param {Uint8Array} occupied 1 where a cell is occupied; the border is closed here
   */
  constructor(width, height, resolution, origin, occupied) {
    this.width = width;
    this.height = height;
    this.resolution = resolution;
    this.origin = origin;
    this.occupied = occupied;
    for (let column = 0; column < width; column += 1) {
      occupied[column] = occupied[(height - 1) * width + column] = 1;
    }
    for (let row = 0; row < height; row += 1) {
      occupied[row * width] = occupied[(row + 1) * width - 1] = 1;
    }
  }

  /**
   * The cell at a place, -1 off the grid.
   * @param {number} x m
   * @param {number} y m
   * @returns {number}
   */
  cellAt(x, y) {
    const column = Math.floor(x / this.resolution);
    const row = Math.floor(y / this.resolution);
    const inside = column >= 0 && row >= 0 && column < this.width && row < this.height;
    return inside ? row * this.width + column : -1;
  }

  /**
   * @param {number} cell
   * @returns {number[]} x m, y m of its center
   */
  centerOf(cell) {
    const column = cell % this.width;
    const row = (cell - column) / this.width;
    return [(column + 0.5) * this.resolution, (row + 0.5) * this.resolution];
  }

  /**
   * Occupy or free cells; the border stays closed.
   * @param {Iterable<number>} cells
   * @param {number} value 1 or 0
   */
  setCells(cells, value) {
    for (const cell of cells) {
      const column = cell % this.width;
      const row = (cell - column) / this.width;
      const inside = column > 0 && row > 0 && column < this.width - 1 && row < this.height - 1;
      if (inside) this.occupied[cell] = value;
    }
  }

  /**
   * The cells of a stroke: those whose center is at most `thickness / 2` from the line, or that hold a
   * point of it.
   * @param {number[]} from x m, y m
   * @param {number[]} to x m, y m
   * @param {number} thickness m
   * @returns {number[]}
   */
  strokeCells(from, to, thickness) {
    throw new Error('to come');
  }

  /**
   * The cells that the center of a round robot may not enter: those with an occupied square nearer to
   * their center than its radius, as `maps.occupancy.traversable` has it.
   * @param {number} radius m
   * @returns {Uint8Array} 1 where it may not
   */
  blockedFor(radius) {
    throw new Error('to come');
  }

  /**
   * The parts of the grid that are connected along rows and columns.
   * @param {Uint8Array} blocked 1 for cells that belong to none
   * @returns {{labels: Int32Array, sizes: number[]}} the part of each cell from 1 on, 0 where it is
   *   blocked; the cells of each part, the first number is 0
   */
  components(blocked) {
    throw new Error('to come');
  }

  /** @returns {Grid} a copy with cells of its own. */
  copy() {
    const { width, height, resolution, origin, occupied } = this;
    return new Grid(width, height, resolution, [...origin], occupied.slice());
  }
}

/**
 * @param {MapData} data `name`, points and `max_steps` are not looked at
 * @returns {Grid}
 */
export function unpackMap(data) {
  throw new Error('to come');
}

/**
 * @param {Grid} grid
 * @returns {string} what stands in `cells` of `MapData`
 */
export function packMap(grid) {
  throw new Error('to come');
}
