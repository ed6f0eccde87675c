import { Coverage } from './coverage.js';
import { Random } from './random.js';
import { castRay } from './raycast.js';

/**
 * The simulator of one robot, as `sqn_jax/env/navigation.py` has it.
 *
 * @typedef {object} EnvSettings the settings `env.*` of a policy by their names, all numbers and texts
 *
 * @typedef {object} Observation what the network sees, all in 0..1
 * @property {Float64Array} ranges readings over the farthest, from the rightmost beam to the leftmost
 * @property {Float64Array} goal distance and heading, as the settings encode them
 * @property {Float64Array} motion the last action, one-hot, and 1 if it was a move that was refused
 *
 * @typedef {object} Step
 * @property {{navigation: number, exploration: number, time: number, total: number}} reward the terms
 *   with their weights, and their sum
 * @property {boolean} reached whether the goal is nearer than its radius
 * @property {boolean} collision whether a move was refused
 * @property {number} freshArea newly seen, m2
 * @property {number} goalDistance m
 */

export const ACTION_NAMES = ['stand still', 'forward', 'backward', 'turn left', 'turn right'];
export const [STAND, FORWARD, BACKWARD, LEFT, RIGHT] = [0, 1, 2, 3, 4];

export class Env {
  /**
   * @param {EnvSettings} settings
   * @param {Grid} grid may be changed in an episode: call `gridChanged` then
   * @param {Random} random for noise
   */
  constructor(settings, grid, random = new Random(0)) {
    this.settings = settings;
    this.grid = grid;
    this.random = random;
    /** Sigma of the velocities and half-width of the readings, in the units of the settings. */
    this.noise = { velocity: 0, range: 0 };
    /** @type {number[]} x m, y m, heading rad in -pi..pi */
    this.pose = [0, 0, 0];
    /** @type {number[]} x m, y m */
    this.goal = [0, 0];
    /** @type {Float64Array} directions of the beams from the heading, rad */
    this.beamAngles = new Float64Array(settings.num_beams);
    /** @type {Float64Array} true readings, m, from the rightmost beam to the leftmost */
    this.ranges = new Float64Array(settings.num_beams);
    /** @type {Uint8Array} 1 for the cells that the robot's center may not enter */
    this.blocked = new Uint8Array();
    /** @type {Coverage | null} */
    this.coverage = null;
    /** Steps taken since `reset`. */
    this.steps = 0;
    throw new Error('to come');
  }

  /** The grid has been changed: what blocks the robot, and what it sees now. */
  gridChanged() {}

  /**
   * Start an episode; what the first scan sees is no reward.
   * @param {number[]} pose x m, y m, heading rad
   * @param {number[]} goal x m, y m
   */
  reset(pose, goal) {}

  /**
   * Advance by one time step.
   * @param {number} action 0 to 4
   * @returns {Step}
   */
  step(action) {}

  /**
   * What the network sees now, with noise on the readings if there is any: call it once a step.
   * @returns {Observation}
   */
  observe() {}

  /**
   * The goal as seen from the robot.
   * @returns {{distance: number, heading: number}} m; rad in -pi..pi, 0 ahead, positive to the left
   */
  goalInRobotFrame() {}

  /**
   * Whether the robot's center may stand at a place.
   * @param {number} x m
   * @param {number} y m
   * @returns {boolean}
   */
  isFree(x, y) {}
}
