/**
 * Exact range readings over a grid: a ray visits cell after cell until one is blocked.
 */

/**
 * Distance from a place to the first blocked cell, 0 in a blocked one.
 * @param {Uint8Array} blocked 1 where a ray ends; the border must be blocked
 * @param {number} width columns
 * @param {number} x in cells
 * @param {number} y in cells
 * @param {number} cosine of the direction
 * @param {number} sine
 * @param {number} limit farthest distance, cells
 * @returns {number} in cells
 */
export function castRay(blocked, width, x, y, cosine, sine, limit) {
  const [column, row] = [Math.floor(x), Math.floor(y)];
  let cell = row * width + column;
  if (blocked[cell]) return 0;
  const [stepX, stepY] = [cosine < 0 ? -1 : 1, sine < 0 ? -width : width];
  // How far it is from border to border along x and along y, and to the first of them.
  const [gapX, gapY] = [1 / Math.abs(cosine), 1 / Math.abs(sine)];
  let toX = cosine === 0 ? Infinity : (cosine < 0 ? x - column : column + 1 - x) * gapX;
  let toY = sine === 0 ? Infinity : (sine < 0 ? y - row : row + 1 - y) * gapY;
  for (;;) {
    const traveled = toX < toY ? toX : toY;
    if (traveled >= limit) return limit;
    if (toX < toY) {
      cell += stepX;
      toX += gapX;
    } else {
      cell += stepY;
      toY += gapY;
    }
    if (blocked[cell]) return traveled;
  }
}
