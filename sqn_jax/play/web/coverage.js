/**
 * The area that the robot has seen, on a turned lattice of points, as `sqn_jax/env/coverage.py` has it: a
 * point is seen if it lies in the field of view and no farther than the reading of the beam nearest in
 * angle. Each point stands for a square of the lattice's cell.
 *
 * To draw it: for each `index` with `seen[index]`, a square of side `cell` m around `place(index)`, turned
 * by `angle`. `fresh` lists the indices that the last scan has added.
 */

/** Direction of the lattice's rows, rad: its tangent is the golden ratio, so that no wall runs along them. */
export const LATTICE_ANGLE = Math.atan((Math.sqrt(5) - 1) / 2);
const LATTICE_COSINE = Math.cos(LATTICE_ANGLE);
const LATTICE_SINE = Math.sin(LATTICE_ANGLE);
/** Points of a lattice: those of a map of 500 x 500 m, or of one that is very long. */
const MOST_POINTS = 2 ** 22;

export class Coverage {
  /**
   * @param {number} width of the map, m
   * @param {number} height of the map, m
   * @param {{coverage_cell: number, max_range: number, field_of_view_deg: number}} settings
   */
  constructor(width, height, settings) {
    this.width = width;
    this.height = height;
    this.maxRange = settings.max_range;
    this.fieldOfView = (settings.field_of_view_deg * Math.PI) / 180;
    /** @type {number} distance of neighboring points, m */
    this.cell = settings.coverage_cell;
    /** @type {number} direction of the lattice's rows on the map, rad */
    this.angle = LATTICE_ANGLE;
    const corners = [[0, 0], [width, 0], [0, height], [width, height]].map(([x, y]) => this.locate(x, y));
    const us = corners.map(([u]) => u);
    const vs = corners.map(([, v]) => v);
    /** @type {number} column and row of the first point, counted from the map's corner */
    [this.left, this.bottom] = [Math.floor(Math.min(...us)), Math.floor(Math.min(...vs))];
    /** @type {number} points in a row */
    this.columns = Math.ceil(Math.max(...us)) - this.left + 1;
    /** @type {number} rows */
    this.rows = Math.ceil(Math.max(...vs)) - this.bottom + 1;
    if (this.columns * this.rows > MOST_POINTS) {
      throw new RangeError(`A map of ${width.toFixed()} x ${height.toFixed()} m is too large for this page.`);
    }
    /** @type {Uint8Array} 1 for the points seen, `row * columns + column` */
    this.seen = new Uint8Array(this.columns * this.rows);
    /** @type {number[]} indices of the points that the last scan saw first */
    this.fresh = [];
    this.count = 0;
    this.onMap = this.seen.map((_, index) => {
      const [x, y] = this.place(index);
      return Number(x >= 0 && x < width && y >= 0 && y < height);
    });
  }

  /** Forget all that was seen. */
  reset() {
    this.seen.fill(0);
    this.fresh = [];
    this.count = 0;
  }

  /**
   * Mark what a scan sees.
   * @param {number[]} pose x m, y m, heading rad
   * @param {Float64Array} ranges true readings, m, from the rightmost beam to the leftmost
   * @returns {number} newly seen area, m2
   */
  addScan(pose, ranges) {
    const [u, v] = this.locate(pose[0], pose[1]);
    const reach = this.maxRange / this.cell;
    const heading = pose[2] - this.angle;
    const clip = (value, first, count) => Math.min(Math.max(value - first, 0), count - 1);
    const top = clip(Math.floor(v + reach), this.bottom, this.rows);
    const right = clip(Math.floor(u + reach), this.left, this.columns);
    this.fresh = [];
    for (let row = clip(Math.ceil(v - reach), this.bottom, this.rows); row <= top; row += 1) {
      for (let column = clip(Math.ceil(u - reach), this.left, this.columns); column <= right; column += 1) {
        const index = row * this.columns + column;
        if (this.seen[index] || !this.onMap[index]) continue;
        const isSeen = this.sees(column + this.left - u, row + this.bottom - v, heading, ranges);
        if (isSeen) this.fresh.push(index);
      }
    }
    for (const index of this.fresh) this.seen[index] = 1;
    this.count += this.fresh.length;
    return this.fresh.length * this.cell ** 2;
  }

  /**
   * Whether a scan sees a point.
   * @param {number} du of the point from the robot, in the frame of the lattice, cells
   * @param {number} dv
   * @param {number} heading of the robot in that frame, rad
   * @param {Float64Array} ranges m
   * @returns {boolean}
   */
  sees(du, dv, heading, ranges) {
    const distance = Math.sqrt(du * du + dv * dv) * this.cell;
    if (distance > this.maxRange) return false;
    const angle = wrapAngle(Math.atan2(dv, du) - heading);
    if (Math.abs(angle) > this.fieldOfView / 2) return false;
    return distance <= ranges[Math.round((angle / this.fieldOfView + 0.5) * (ranges.length - 1))];
  }

  /** @returns {number} seen area, m2 */
  area() {
    return this.count * this.cell ** 2;
  }

  /**
   * @param {number} index of a point
   * @returns {number[]} x m, y m on the map
   */
  place(index) {
    const column = index % this.columns;
    const u = (column + this.left) * this.cell;
    const v = ((index - column) / this.columns + this.bottom) * this.cell;
    return [LATTICE_COSINE * u - LATTICE_SINE * v, LATTICE_COSINE * v + LATTICE_SINE * u];
  }

  /**
   * Whether the point nearest to a place was seen.
   * @param {number} x m
   * @param {number} y m
   * @returns {boolean}
   */
  isSeen(x, y) {
    const [u, v] = this.locate(x, y);
    const [column, row] = [Math.round(u) - this.left, Math.round(v) - this.bottom];
    const inside = column >= 0 && row >= 0 && column < this.columns && row < this.rows;
    return inside && this.seen[row * this.columns + column] === 1;
  }

  /**
   * A place in the frame of the lattice.
   * @param {number} x m
   * @param {number} y m
   * @returns {number[]} column and row, counted from the map's corner
   */
  locate(x, y) {
    const u = (LATTICE_COSINE * x + LATTICE_SINE * y) / this.cell;
    return [u, (LATTICE_COSINE * y - LATTICE_SINE * x) / this.cell];
  }
}

/**
 * @param {number} angle rad
 * @returns {number} the angle in -pi..pi, pi left out
 */
export function wrapAngle(angle) {
  const turns = (angle + Math.PI) / (2 * Math.PI);
  return (turns - Math.floor(turns)) * 2 * Math.PI - Math.PI;
}
