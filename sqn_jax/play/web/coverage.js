/**
 * The area that the robot has seen, on a turned lattice of points, as `sqn_jax/env/coverage.py` has it: a
 * point is seen if it lies in the field of view and no farther than the reading of the beam nearest in
 * angle. Each point stands for a square of the lattice's cell.
 *
 * To draw it: for each `index` with `seen[index]`, a square of side `cell` m around `place(index)`, turned
 * by `angle`. `fresh` lists the indices that the last scan has added.
 */
export class Coverage {
  /**
   * @param {number} width of the map, m
   * @param {number} height of the map, m
   * @param {{coverage_cell: number, max_range: number, field_of_view_deg: number}} settings
   */
  constructor(width, height, settings) {
    throw new Error('to come');
    /** @type {number} distance of neighboring points, m */
    this.cell = 0;
    /** @type {number} direction of the lattice's rows on the map, rad */
    this.angle = 0;
    /** @type {number} points in a row */
    this.columns = 0;
    /** @type {number} rows */
    this.rows = 0;
    /** @type {Uint8Array} 1 for the points seen, `row * columns + column` */
    this.seen = new Uint8Array();
    /** @type {number[]} indices of the points that the last scan saw first */
    this.fresh = [];
  }

  /** Forget all that was seen. */
  reset() {}

  /**
   * Mark what a scan sees.
   * @param {number[]} pose x m, y m, heading rad
   * @param {Float64Array} ranges true readings, m, from the rightmost beam to the leftmost
   * @returns {number} newly seen area, m2
   */
  addScan(pose, ranges) {}

  /** @returns {number} seen area, m2 */
  area() {}

  /**
   * @param {number} index of a point
   * @returns {number[]} x m, y m on the map
   */
  place(index) {}

  /**
   * Whether the point nearest to a place was seen.
   * @param {number} x m
   * @param {number} y m
   * @returns {boolean}
   */
  isSeen(x, y) {}
}
