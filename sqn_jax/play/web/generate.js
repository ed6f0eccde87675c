import { Grid } from './grid.js';

/**
 * New maps: a maze with corridors of several widths, rooms with doors, clutter. On each of them the robot
 * gets everywhere it fits.
 */

export const MAP_KINDS = ['maze', 'rooms', 'clutter'];

/** Lengths in m: sides of the chambers that the map is divided into, walls, and openings in them. */
const CHAMBERS = {
  maze: { sides: [0.8, 2.2], wall: [0.1, 0.3], openings: [0.7, 2.2], loops: 0.08, obstacles: 0 },
  rooms: { sides: [2.5, 5], wall: [0.1, 0.2], openings: [0.8, 1.3], loops: 0.4, obstacles: 12 },
  clutter: { sides: [100, 100], wall: [0.1, 0.1], openings: [1, 1], loops: 0, obstacles: 45 },
};

/** m of side or diameter. */
const OBSTACLES = [0.2, 1.6];

/** Starts and goals keep so far from walls, m, beyond the robot's radius. */
const MARGIN = 0.15;

/**
 * @param {string} kind one of `MAP_KINDS`
 * @param {Random} random
 * @param {{size?: number, resolution?: number, radius?: number}} options m of a side, m per cell, m of the
 *   robot: 17, 0.05 and 0.1
 * @returns {{grid: Grid, start: number[], goal: number[]}} pose x m, y m, heading rad; x m, y m
 */
export function generateMap(kind, random, options = {}) {
  const { size = 17, resolution = 0.05, radius = 0.1 } = options;
  const side = Math.round(size / resolution);
  const grid = new Grid(side, side, resolution, [0, 0, 0], new Uint8Array(side * side).fill(1));
  const style = CHAMBERS[kind];
  const columns = divided(side, style, resolution, random);
  const rows = divided(side, style, resolution, random);
  for (const [bottom, top] of rows) {
    for (const [left, right] of columns) fillBox(grid, left, bottom, right, top, 0);
  }
  for (const [from, to] of chosenOpenings(columns.length, rows.length, style.loops, random)) {
    cutOpening(grid, columns, rows, from, to, style, random);
  }
  addObstacles(grid, style.obstacles, radius, random);
  return { grid, ...drawTask(grid, radius, random) };
}

/** Intervals of cells [first, last) between walls, from one side of the map to the other. */
function divided(side, style, resolution, random) {
  const inCells = (bounds) => Math.max(1, Math.round(random.between(...bounds) / resolution));
  const least = Math.round(style.sides[0] / resolution);
  const intervals = [];
  let first = 1;
  while (first < side - 1) {
    const last = first + inCells(style.sides);
    const next = last + inCells(style.wall);
    // What is left has to hold another chamber; else this one takes it.
    if (next + least > side - 1) {
      intervals.push([first, side - 1]);
      break;
    }
    intervals.push([first, last]);
    first = next;
  }
  return intervals;
}

function fillBox(grid, left, bottom, right, top, value) {
  const cells = [];
  for (let row = bottom; row < top; row += 1) {
    for (let column = left; column < right; column += 1) cells.push(row * grid.width + column);
  }
  grid.setCells(cells, value);
}

/**
 * Pairs of neighboring chambers between which a wall opens: such that each is reached from each on one
 * way, and a fraction `loops` of the other walls.
 */
function chosenOpenings(numColumns, numRows, loops, random) {
  const pairs = [];
  for (let row = 0; row < numRows; row += 1) {
    for (let column = 0; column < numColumns; column += 1) {
      const chamber = row * numColumns + column;
      if (column + 1 < numColumns) pairs.push([chamber, chamber + 1]);
      if (row + 1 < numRows) pairs.push([chamber, chamber + numColumns]);
    }
  }
  // Chambers that are connected already lead to the same root.
  const leads = Array.from({ length: numColumns * numRows }, (_, chamber) => chamber);
  const root = (chamber) => (leads[chamber] === chamber ? chamber : root(leads[chamber]));
  return random.shuffle(pairs).filter(([from, to]) => {
    if (root(from) === root(to)) return random.uniform() < loops;
    leads[root(from)] = root(to);
    return true;
  });
}

/** Open the wall between two neighboring chambers somewhere along their common side. */
function cutOpening(grid, columns, rows, from, to, style, random) {
  const [fromColumn, fromRow] = [from % columns.length, Math.floor(from / columns.length)];
  const isBeside = to === from + 1;
  const [low, high] = isBeside ? rows[fromRow] : columns[fromColumn];
  const wanted = Math.round(random.between(...style.openings) / grid.resolution);
  const length = Math.min(wanted, high - low);
  const first = low + random.integer(high - low - length + 1);
  if (isBeside) {
    const [wall, end] = [columns[fromColumn][1], columns[fromColumn + 1][0]];
    fillBox(grid, wall, first, end, first + length, 0);
  } else {
    const [wall, end] = [rows[fromRow][1], rows[fromRow + 1][0]];
    fillBox(grid, first, wall, first + length, end, 0);
  }
}

/** Put boxes and discs where they leave the free space in one piece. */
function addObstacles(grid, count, radius, random) {
  for (let obstacle = 0; obstacle < count; obstacle += 1) {
    const before = grid.occupied.slice();
    const [x, y] = [random.uniform() * grid.width, random.uniform() * grid.height];
    const [across, up] = [0, 1].map(() => random.between(...OBSTACLES) / 2 / grid.resolution);
    const isRound = random.uniform() < 0.5;
    for (let cell = 0; cell < before.length; cell += 1) {
      const column = cell % grid.width;
      const [dx, dy] = [column + 0.5 - x, (cell - column) / grid.width + 0.5 - y];
      const isInside = isRound ? dx * dx + dy * dy < across * across : Math.abs(dx) < across && Math.abs(dy) < up;
      if (isInside) grid.occupied[cell] = 1;
    }
    const { sizes } = grid.components(grid.blockedFor(radius));
    if (sizes.length > 2) grid.occupied.set(before);
  }
}

/** A start and the farthest of some places as the goal, both a little away from walls. */
function drawTask(grid, radius, random) {
  const blocked = grid.blockedFor(radius + MARGIN);
  const free = [];
  blocked.forEach((value, cell) => value || free.push(cell));
  const place = () => grid.centerOf(free[random.integer(free.length)]);
  const [x, y] = place();
  const away = ([goalX, goalY]) => Math.hypot(goalX - x, goalY - y);
  const goals = Array.from({ length: 30 }, place).sort((a, b) => away(b) - away(a));
  return { start: [x, y, random.between(-Math.PI, Math.PI)], goal: goals[0] };
}
