// node --test units.mjs: the parts of the page's simulator against brute force.

import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Coverage, wrapAngle } from '../../sqn_jax/play/web/coverage.js';
import { generateMap, MAP_KINDS } from '../../sqn_jax/play/web/generate.js';
import { Grid, packMap, unpackMap } from '../../sqn_jax/play/web/grid.js';
import { decodeHalves } from '../../sqn_jax/play/web/network.js';
import { Random } from '../../sqn_jax/play/web/random.js';
import { castRay } from '../../sqn_jax/play/web/raycast.js';

/** A grid of random cells, an odd number of them, with `density` of them occupied. */
function randomGrid(random, width, height, density, resolution = 0.1) {
  const occupied = Uint8Array.from({ length: width * height }, () => Number(random.uniform() < density));
  return new Grid(width, height, resolution, [1, 2, 0.5], occupied);
}

test('a ray ends where small steps along it first come into a blocked cell', () => {
  const random = new Random(1);
  const [step, limit] = [1e-3, 12];
  for (let ray = 0; ray < 300; ray += 1) {
    const grid = randomGrid(random, 23, 17, 0.1);
    const [x, y] = [random.between(1, 22), random.between(1, 16)];
    const isBlocked = (u, v) => grid.occupied[Math.floor(v) * 23 + Math.floor(u)] === 1;
    // Every fourth along an axis.
    const angle = ray % 4 === 0 ? ((ray / 4) % 4) * (Math.PI / 2) : random.between(-4, 4);
    const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
    let marched = 0;
    while (marched < limit && !isBlocked(x + cosine * marched, y + sine * marched)) marched += step;
    const reading = castRay(grid.occupied, 23, x, y, cosine, sine, limit);
    // Steps may pass over a corner: then the cell where the ray ends is blocked all the same.
    const inside = isBlocked(x + cosine * (reading + 1e-9), y + sine * (reading + 1e-9));
    const isSame = Math.abs(reading - Math.min(marched, limit)) <= step + 1e-9;
    assert.ok(isSame || (reading < marched && inside), `ray ${ray}: ${reading}, marched ${marched}`);
  }
});

test('rays exactly along the axes end at the wall', () => {
  const grid = new Grid(10, 8, 1, [0, 0, 0], new Uint8Array(80));
  const reading = (cosine, sine) => castRay(grid.occupied, 10, 2.5, 3.25, cosine, sine, 100);
  assert.deepEqual([reading(1, 0), reading(-1, 0), reading(0, 1), reading(0, -1)], [6.5, 1.5, 3.75, 2.25]);
  assert.equal(castRay(grid.occupied, 10, 0.5, 0.5, 1, 0, 100), 0);
});

test('a map survives packing, and its border is closed', () => {
  const random = new Random(2);
  const grid = randomGrid(random, 13, 7, 0.3);
  const { width, height, resolution, origin } = grid;
  const again = unpackMap({ width, height, resolution, origin, cells: packMap(grid) });
  assert.deepEqual(again, grid);
  grid.setCells([0, 12, 20, 6 * 13 + 5], 0);
  grid.setCells([20], 0);
  assert.equal(grid.occupied[20], 0);
  const border = [0, 12, 6 * 13 + 5].map((cell) => grid.occupied[cell]);
  assert.deepEqual(border, [1, 1, 1]);
  assert.throws(() => unpackMap({ width, height: 8, resolution, origin, cells: packMap(grid) }), /bytes/);
});

test('a stroke takes the cells whose centers are near its line, and has no gaps', () => {
  const grid = new Grid(40, 30, 0.1, [0, 0, 0], new Uint8Array(1200));
  const random = new Random(3);
  for (let stroke = 0; stroke < 12; stroke += 1) {
    const [from, to] = [0, 1].map(() => [random.between(-0.5, 4.5), random.between(-0.5, 3.5)]);
    const reach = stroke % 3 === 0 ? 0.001 : 0.2;
    const cells = grid.strokeCells(from, to, 2 * reach);
    const line = Array.from({ length: 401 }, (_, part) =>
      [0, 1].map((axis) => from[axis] + ((to[axis] - from[axis]) * part) / 400),
    );
    const onLine = new Set(line.map(([x, y]) => grid.cellAt(x, y)));
    for (let cell = 0; cell < 1200; cell += 1) {
      const [x, y] = grid.centerOf(cell);
      const nearest = Math.min(...line.map((place) => Math.hypot(place[0] - x, place[1] - y)));
      if (nearest < reach - 0.01) assert.ok(cells.includes(cell), `${stroke}: ${cell} is left out`);
      if (nearest > reach && !onLine.has(cell)) assert.ok(!cells.includes(cell), `${stroke}: ${cell}`);
    }
    // From one of its cells all are reached, across corners too.
    const left = new Set(cells);
    assert.equal(left.size, cells.length);
    const waiting = cells.slice(0, 1);
    for (let cell = waiting.pop(); cell !== undefined; cell = waiting.pop()) {
      if (!left.delete(cell)) continue;
      for (const up of [-40, 0, 40]) waiting.push(cell + up - 1, cell + up, cell + up + 1);
    }
    assert.equal(left.size, 0, `stroke ${stroke} has a gap`);
  }
});

test('a scan sees what lies in the sector of a beam, no farther than its reading', () => {
  const settings = { coverage_cell: 0.2, max_range: 2, field_of_view_deg: 270 };
  const coverage = new Coverage(6, 5, settings);
  const random = new Random(4);
  const ranges = Float64Array.from({ length: 10 }, () => random.between(0.3, 2));
  const pose = [2.9, 2.4, 3];
  const area = coverage.addScan(pose, ranges);
  // 10 beams over 270 degrees are 30 degrees apart: beam k looks to -135 + 30 k.
  let count = 0;
  for (let index = 0; index < coverage.seen.length; index += 1) {
    const [x, y] = coverage.place(index);
    const distance = Math.hypot(x - pose[0], y - pose[1]);
    const degrees = (wrapAngle(Math.atan2(y - pose[1], x - pose[0]) - pose[2]) * 180) / Math.PI;
    const aside = ranges.map((_, beam) => Math.abs(degrees - (-135 + 30 * beam)));
    const beam = aside.indexOf(Math.min(...aside));
    const inside = x >= 0 && y >= 0 && x < 6 && y < 5;
    const expected = inside && Math.abs(degrees) <= 135 && distance <= ranges[beam];
    assert.equal(coverage.seen[index] === 1, expected, `point ${index} at ${degrees} degrees`);
    assert.equal(coverage.isSeen(x + 0.05, y - 0.05), expected);
    count += Number(expected);
  }
  assert.ok(count > 20);
  assert.equal(coverage.fresh.length, count);
  assert.ok(Math.abs(area - count * 0.04) < 1e-9 && Math.abs(coverage.area() - area) < 1e-9);
  assert.equal(coverage.addScan(pose, ranges), 0);
  coverage.reset();
  assert.equal(coverage.area(), 0);
});

test('half-precision numbers are decoded', () => {
  // IEEE 754: 1, -2, the largest, the smallest normal and subnormal ones, zeros, the number after 1, 1/3.
  const bits = [0x3c00, 0xc000, 0x7bff, 0x0400, 0x0001, 0x0000, 0x8000, 0x3c01, 0x3555];
  const bytes = new Uint8Array(bits.flatMap((word) => [word & 255, word >> 8]));
  const expected = [1, -2, 65504, 2 ** -14, 2 ** -24, 0, -0, 1 + 2 ** -10, 0.333251953125];
  assert.deepEqual([...decodeHalves(bytes)], expected);
});

test('random numbers are spread as they should be, and the same for a seed', () => {
  const [random, same, other] = [new Random(5), new Random(5), new Random(6)];
  const numbers = Array.from({ length: 20000 }, () => random.uniform());
  assert.deepEqual(numbers.slice(0, 9), Array.from({ length: 9 }, () => same.uniform()));
  assert.notEqual(numbers[0], other.uniform());
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const bins = new Array(20).fill(0);
  for (const number of numbers) bins[Math.floor(number * 20)] += 1;
  // Chi squared of 19 degrees of freedom: above 44 once in a thousand.
  assert.ok(bins.reduce((sum, count) => sum + (count - 1000) ** 2 / 1000, 0) < 44);
  const products = numbers.slice(1).map((number, index) => (number - 0.5) * (numbers[index] - 0.5));
  assert.ok(Math.abs(mean(products)) < 0.0025);
  const normals = Array.from({ length: 20000 }, () => random.normal());
  const powers = [1, 2, 3, 4].map((power) => mean(normals.map((number) => number ** power)));
  powers.forEach((moment, index) => assert.ok(Math.abs(moment - [0, 1, 0, 3][index]) < 0.2, `${powers}`));
  const draws = Array.from({ length: 600 }, () => random.integer(6));
  assert.deepEqual([...new Set(draws)].sort(), [0, 1, 2, 3, 4, 5]);
  assert.deepEqual([...random.shuffle([1, 2, 3, 4])].sort(), [1, 2, 3, 4]);
});

for (const kind of MAP_KINDS) {
  test(`a robot gets everywhere on a map of ${kind}`, () => {
    const seen = new Set();
    for (let seed = 0; seed < 4; seed += 1) {
      const { grid, start, goal } = generateMap(kind, new Random(seed));
      assert.deepEqual([grid.width, grid.height, grid.resolution], [340, 340, 0.05]);
      const blocked = grid.blockedFor(0.1);
      assert.equal(grid.components(blocked).sizes.length, 2, `seed ${seed}`);
      const wide = grid.blockedFor(0.2);
      for (const place of [start, goal]) assert.equal(wide[grid.cellAt(place[0], place[1])], 0);
      assert.ok(Math.hypot(goal[0] - start[0], goal[1] - start[1]) > 5);
      const free = grid.occupied.reduce((count, value) => count + 1 - value, 0) / grid.occupied.length;
      assert.ok(free > 0.5 && free < 0.98, `${free}`);
      seen.add(packMap(grid));
    }
    assert.equal(seen.size, 4);
  });
}

test('a map for which the lattice would be too large is refused', () => {
  const settings = { coverage_cell: 0.325, max_range: 5, field_of_view_deg: 350 };
  assert.equal(new Coverage(51, 51, settings).count, 0);
  for (const [width, height] of [[8, 40000], [40000, 8], [900, 900]]) {
    assert.throws(() => new Coverage(width, height, settings), /too large for this page/);
  }
});
