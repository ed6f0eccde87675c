/**
 * Shortest paths for the robot's center, as `sqn_jax/maps/distance.py` measures them: over the centers of
 * free cells by moves of up to 3 cells across and up, which touch no blocked cell.
 */

/** Cells this near to the goal get their straight distance if all between is free. */
const NEAR_CELLS = 12;

/** The 32 moves, each with the cells that its line touches. */
const PATH_MOVES = pathMoves();

/**
 * @param {Grid} grid
 * @param {Uint8Array} blocked from `grid.blockedFor(radius)`
 * @param {number[]} from x m, y m
 * @param {number[]} to x m, y m
 * @returns {{length: number, points: number[][]} | null} m from the center of the first cell to the goal,
 *   and the corners of the path [x m, y m] from start to goal; null where there is none
 */
export function shortestPath(grid, blocked, from, to) {
  const [start, end] = [grid.cellAt(...from), grid.cellAt(...to)];
  if (start < 0 || end < 0 || blocked[start] || blocked[end]) return null;
  const { width } = grid;
  const [goalX, goalY] = to.map((meters) => meters / grid.resolution);
  const straight = (cell) => {
    const column = cell % width;
    const [dx, dy] = [column + 0.5 - goalX, (cell - column) / width + 0.5 - goalY];
    // Several times faster than Math.hypot.
    return Math.sqrt(dx * dx + dy * dy);
  };
  const moves = PATH_MOVES.map((move) => {
    const touched = Int32Array.from(move.cells, ([up, right]) => up * width + right);
    return { ...move, touched };
  });
  const near = new Map(cellsSeenFrom(grid, blocked, end).map((cell) => [cell, straight(cell)]));
  // Best first, by length so far plus the straight line, which is never longer than what is left.
  const lengths = new Float64Array(blocked.length).fill(Infinity);
  const before = new Int32Array(blocked.length).fill(-1);
  const queue = new Heap();
  let [best, last] = [Infinity, -1];
  lengths[start] = 0;
  queue.push(straight(start), start);
  while (queue.size > 0 && queue.smallest() < best) {
    const promised = queue.smallest();
    const cell = queue.pop();
    if (promised > lengths[cell] + straight(cell) + 1e-9) continue;
    if (near.has(cell) && lengths[cell] + near.get(cell) < best) {
      [best, last] = [lengths[cell] + near.get(cell), cell];
    }
    const column = cell % width;
    const row = (cell - column) / width;
    for (const move of moves) {
      const [x, y] = [column + move.right, row + move.up];
      if (x < 0 || y < 0 || x >= width || y >= grid.height) continue;
      const next = y * width + x;
      const length = lengths[cell] + move.length;
      if (length >= lengths[next] || !isClear(blocked, cell, move.touched)) continue;
      lengths[next] = length;
      before[next] = cell;
      queue.push(length + straight(next), next);
    }
  }
  if (last < 0) return null;
  const points = [];
  for (let cell = last; cell !== start; cell = before[cell]) points.push(grid.centerOf(cell));
  return { length: best * grid.resolution, points: [from, ...points.reverse(), to] };
}

function pathMoves() {
  const moves = [];
  for (let up = -3; up <= 3; up += 1) {
    for (let right = -3; right <= 3; right += 1) {
      if (greatestDivisor(Math.abs(up), Math.abs(right)) !== 1) continue;
      moves.push({ up, right, length: Math.hypot(up, right), cells: lineCells(up, right) });
    }
  }
  return moves;
}

function greatestDivisor(a, b) {
  return b === 0 ? a : greatestDivisor(b, a % b);
}

/** Offsets [up, right] of the cells that the line from center to center touches, be it at a corner. */
function lineCells(up, right) {
  const [rows, columns] = [Math.abs(up), Math.abs(right)];
  const cells = [];
  for (let i = 0; i <= rows; i += 1) {
    for (let j = 0; j <= columns; j += 1) {
      if (2 * Math.abs(rows * j - columns * i) <= rows + columns) {
        cells.push([Math.sign(up) * i, Math.sign(right) * j]);
      }
    }
  }
  return cells;
}

/** Whether a move from a free cell, which ends on the grid, touches free cells only. */
function isClear(blocked, cell, touched) {
  for (const offset of touched) {
    if (blocked[cell + offset]) return false;
  }
  return true;
}

/** Cells at most `NEAR_CELLS` away for which the rectangle between them and a cell is all free. */
function cellsSeenFrom(grid, blocked, cell) {
  const { width, height } = grid;
  const column = cell % width;
  const row = (cell - column) / width;
  const cells = new Set();
  for (const up of [1, -1]) {
    for (const right of [1, -1]) {
      let most = NEAR_CELLS;
      for (let i = 0; i <= NEAR_CELLS; i += 1) {
        const y = row + up * i;
        if (y < 0 || y >= height) break;
        for (let j = 0; j <= most; j += 1) {
          const x = column + right * j;
          if (x < 0 || x >= width || blocked[y * width + x]) {
            most = j - 1;
            break;
          }
          cells.add(y * width + x);
        }
      }
    }
  }
  return [...cells];
}

/** A queue of cells, the one with the smallest key first. */
class Heap {
  constructor() {
    this.keys = [];
    this.cells = [];
  }

  get size() {
    return this.keys.length;
  }

  smallest() {
    return this.keys[0];
  }

  push(key, cell) {
    const { keys, cells } = this;
    let place = keys.length;
    for (let parent; place > 0; place = parent) {
      parent = (place - 1) >> 1;
      if (keys[parent] <= key) break;
      [keys[place], cells[place]] = [keys[parent], cells[parent]];
    }
    [keys[place], cells[place]] = [key, cell];
  }

  /** @returns {number} the cell with the smallest key, which is taken out */
  pop() {
    const { keys, cells } = this;
    const first = cells[0];
    const [key, cell] = [keys.pop(), cells.pop()];
    const size = keys.length;
    if (size === 0) return first;
    let place = 0;
    for (;;) {
      let child = 2 * place + 1;
      if (child + 1 < size && keys[child + 1] < keys[child]) child += 1;
      if (child >= size || keys[child] >= key) break;
      [keys[place], cells[place]] = [keys[child], cells[child]];
      place = child;
    }
    [keys[place], cells[place]] = [key, cell];
    return first;
  }
}
