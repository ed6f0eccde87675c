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
    const reach = thickness / 2 / this.resolution;
    const [x, y] = from.map((meters) => meters / this.resolution);
    const [dx, dy] = [to[0] / this.resolution - x, to[1] / this.resolution - y];
    const squaredLength = dx * dx + dy * dy;
    const cells = new Set();
    // Points of the line half a cell apart, so that a thin one has no gaps.
    const points = Math.ceil(2 * Math.sqrt(squaredLength)) + 1;
    for (let point = 0; point <= points; point += 1) {
      const place = point / points;
      const cell = this.cellAt(to[0] * place + from[0] * (1 - place), to[1] * place + from[1] * (1 - place));
      if (cell >= 0) cells.add(cell);
    }
    const clip = (value, most) => Math.min(Math.max(Math.floor(value), 0), most - 1);
    const right = clip(Math.max(x, x + dx) + reach, this.width);
    const top = clip(Math.max(y, y + dy) + reach, this.height);
    for (let row = clip(Math.min(y, y + dy) - reach, this.height); row <= top; row += 1) {
      for (let column = clip(Math.min(x, x + dx) - reach, this.width); column <= right; column += 1) {
        const [u, v] = [column + 0.5 - x, row + 0.5 - y];
        const along = squaredLength > 0 ? Math.min(Math.max((u * dx + v * dy) / squaredLength, 0), 1) : 0;
        if (Math.hypot(u - along * dx, v - along * dy) <= reach) cells.add(row * this.width + column);
      }
    }
    return [...cells];
  }

  /**
   * The cells that the center of a round robot may not enter: those with an occupied square nearer to
   * their center than its radius, as `maps.occupancy.traversable` has it.
   * @param {number} radius m
   * @returns {Uint8Array} 1 where it may not
   */
  blockedFor(radius) {
    const { width, height, occupied } = this;
    const blocked = occupied.slice();
    // The same slack as in Python: 0.15 / 0.05 is not exactly 3.
    const reach = radius / this.resolution - 1e-6;
    const offsets = closeOffsets(reach);
    const flatOffsets = Int32Array.from(offsets, ([up, right]) => up * width + right);
    const margin = Math.max(1, Math.ceil(reach + 0.5) - 1);
    for (let cell = 0; cell < occupied.length; cell += 1) {
      if (!occupied[cell]) continue;
      const column = cell % width;
      const row = (cell - column) / width;
      if (column >= margin && row >= margin && column < width - margin && row < height - margin) {
        const beside = occupied[cell - 1] + occupied[cell + 1];
        // Whatever is near to a cell among occupied ones is nearer to one of these.
        if (beside + occupied[cell - width] + occupied[cell + width] === 4) continue;
        for (const offset of flatOffsets) blocked[cell + offset] = 1;
        continue;
      }
      for (const [up, right] of offsets) {
        const [y, x] = [row + up, column + right];
        if (x >= 0 && y >= 0 && x < width && y < height) blocked[y * width + x] = 1;
      }
    }
    return blocked;
  }

  /**
   * The parts of the grid that are connected along rows and columns.
   * @param {Uint8Array} blocked 1 for cells that belong to none
   * @returns {{labels: Int32Array, sizes: number[]}} the part of each cell from 1 on, 0 where it is
   *   blocked; the cells of each part, the first number is 0
   */
  components(blocked) {
    const labels = new Int32Array(blocked.length);
    const sizes = [0];
    const stack = new Int32Array(blocked.length);
    const { width } = this;
    for (let seed = 0; seed < blocked.length; seed += 1) {
      if (blocked[seed] || labels[seed]) continue;
      const label = sizes.length;
      let [size, waiting] = [1, 1];
      labels[seed] = label;
      stack[0] = seed;
      while (waiting > 0) {
        waiting -= 1;
        const cell = stack[waiting];
        // The border is blocked, so that no neighbor lies beyond it.
        for (const neighbor of [cell - 1, cell + 1, cell - width, cell + width]) {
          if (blocked[neighbor] || labels[neighbor]) continue;
          labels[neighbor] = label;
          stack[waiting] = neighbor;
          waiting += 1;
          size += 1;
        }
      }
      sizes.push(size);
    }
    return { labels, sizes };
  }

  /** @returns {Grid} a copy with cells of its own. */
  copy() {
    const { width, height, resolution, origin, occupied } = this;
    return new Grid(width, height, resolution, [...origin], occupied.slice());
  }
}

/** The offsets [up, right] of cells whose center is nearer than `reach` cells to the square of one at 0. */
function closeOffsets(reach) {
  const offsets = [];
  const most = Math.ceil(reach + 0.5);
  for (let up = -most; up <= most; up += 1) {
    for (let right = -most; right <= most; right += 1) {
      const [away, aside] = [Math.max(Math.abs(up) - 0.5, 0), Math.max(Math.abs(right) - 0.5, 0)];
      if (Math.hypot(away, aside) < reach) offsets.push([up, right]);
    }
  }
  return offsets;
}

/**
 * @param {MapData} data `name`, points and `max_steps` are not looked at
 * @returns {Grid}
 */
export function unpackMap(data) {
  const bytes = decodeBase64(data.cells);
  const occupied = new Uint8Array(data.width * data.height);
  if (bytes.length !== Math.ceil(occupied.length / 8)) {
    throw new Error(`a map of ${data.width} x ${data.height} cells has ${bytes.length} bytes`);
  }
  for (let cell = 0; cell < occupied.length; cell += 1) {
    occupied[cell] = (bytes[cell >> 3] >> (7 - (cell & 7))) & 1;
  }
  return new Grid(data.width, data.height, data.resolution, [...data.origin], occupied);
}

/**
 * @param {Grid} grid
 * @returns {string} what stands in `cells` of `MapData`
 */
export function packMap(grid) {
  const bytes = new Uint8Array(Math.ceil(grid.occupied.length / 8));
  for (let cell = 0; cell < grid.occupied.length; cell += 1) {
    bytes[cell >> 3] |= grid.occupied[cell] << (7 - (cell & 7));
  }
  let text = '';
  for (const byte of bytes) text += String.fromCharCode(byte);
  return btoa(text);
}

/**
 * @param {string} text
 * @returns {Uint8Array}
 */
export function decodeBase64(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}
