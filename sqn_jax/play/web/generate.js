import { Grid } from './grid.js';

/**
 * New maps: a maze with corridors of several widths, rooms with doors, clutter. On each of them the robot
 * gets everywhere it fits.
 */

export const MAP_KINDS = ['maze', 'rooms', 'clutter'];

/**
 * @param {string} kind one of `MAP_KINDS`
 * @param {Random} random
 * @param {{size?: number, resolution?: number, radius?: number}} options m of a side, m per cell, m of the
 *   robot: 17, 0.05 and 0.1
 * @returns {{grid: Grid, start: number[], goal: number[]}} pose x m, y m, heading rad; x m, y m
 */
export function generateMap(kind, random, options = {}) {
  throw new Error('to come');
}
