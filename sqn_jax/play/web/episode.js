import { Env } from './env.js';
import { Policy } from './network.js';
import { Random } from './random.js';
import { shortestPath } from './paths.js';

/**
 * One robot's episode on a task, with what the panels show of it.
 *
 * @typedef {object} Task
 * @property {number[]} start x m, y m, heading rad
 * @property {number[]} goal x m, y m
 *
 * @typedef {object} Moment one step, for the strips over time
 * @property {Float32Array} weights skill weights
 * @property {Float32Array} hidden recurrent state
 * @property {object} reward the terms and their sum, as `Env.step` returns them
 */

const FEWEST_FREE_CELLS = 50;

export class Episode {
  /**
   * @param {PolicyData} policyData its policy acts where no action is given
   * @param {Grid} grid
   * @param {Random} random for noise and random actions
   */
  constructor(policyData, grid, random) {
    this.env = new Env(policyData.env, grid, random);
    this.policy = new Policy(policyData, random);
    this.epsilon = 0;
  }

  /**
   * @param {Task} task
   * @param {number} limit steps after which the goal counts as not reached
   */
  start(task, limit) {
    this.env.reset(task.start, task.goal);
    this.policy.reset();
    this.limit = limit;
    /** @type {'running' | 'reached' | 'failed'} */
    this.outcome = 'running';
    this.collisions = 0;
    this.trail = [this.env.pose.slice(0, 2)];
    /** @type {Moment[]} */
    this.moments = [];
    this.decision = null;
  }

  /** @returns {boolean} */
  get isOver() {
    return this.outcome !== 'running';
  }

  /**
   * Take a step. The policy looks on also where an action is given.
   * @param {number | null} given an action in place of the policy's
   */
  advance(given = null) {
    this.decision = this.policy.act(this.env.observe(), this.epsilon);
    if (given !== null) this.decision.action = given;
    const { reward, reached, collision } = this.env.step(this.decision.action);
    this.trail.push(this.env.pose.slice(0, 2));
    const { weights, hidden } = this.decision;
    this.moments.push({ weights, hidden, reward });
    if (collision) this.collisions += 1;
    if (reached) this.outcome = 'reached';
    else if (this.env.steps >= this.limit) this.outcome = 'failed';
  }

  /** @returns {Robot} for the map's picture. */
  robot(isGhost) {
    const weights = this.moments.map((moment) => moment.weights);
    return { pose: this.env.pose, trail: this.trail, weights, isGhost };
  }
}

/**
 * A task at random: between two of the given points, or two free places, with a way between them.
 * @param {Grid} grid
 * @param {Uint8Array} blocked from `grid.blockedFor(radius)`
 * @param {number[][]} points x m, y m each, from which to choose if two of them can be used
 * @param {Random} random
 * @returns {Task | null} null where there is no room
 */
export function randomTask(grid, blocked, points, random) {
  const { labels, sizes } = grid.components(blocked);
  // The part of the first point, or else the largest.
  let label = points.length ? labels[grid.cellAt(...points[0])] : 0;
  if (!label) label = sizes.indexOf(Math.max(0, ...sizes.slice(1)));
  if (label < 1 || sizes[label] < FEWEST_FREE_CELLS) return null;
  const usable = points.filter((point) => labels[grid.cellAt(...point)] === label);
  const count = usable.length > 1 ? usable.length : sizes[label];
  const start = random.integer(count);
  const goal = (start + 1 + random.integer(count - 1)) % count;
  const [from, to] = [start, goal].map((index) =>
    usable.length > 1 ? usable[index] : grid.centerOf(cellOfPart(labels, label, index)),
  );
  return { start: [...from, random.between(-Math.PI, Math.PI)], goal: [...to] };
}

/** The cell that comes `index` cells after the first of a part. */
function cellOfPart(labels, label, index) {
  let cell = labels.indexOf(label);
  for (let left = index; left > 0; left -= 1) cell = labels.indexOf(label, cell + 1);
  return cell;
}

/**
 * The shortest path of a task.
 * @param {Grid} grid
 * @param {Uint8Array} blocked from `grid.blockedFor(radius)`
 * @param {Task} task
 * @param {EnvSettings} settings
 * @returns {{length: number, points: number[][], steps: number} | null} m, corners, and the steps that it
 *   takes at full speed; null where there is none
 */
export function pathOf(grid, blocked, task, settings) {
  const path = shortestPath(grid, blocked, task.start.slice(0, 2), task.goal);
  const perStep = settings.forward_speed * settings.time_step;
  return path && { ...path, steps: Math.max(1, Math.ceil(path.length / perStep)) };
}
