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
  throw new Error('to come');
}
