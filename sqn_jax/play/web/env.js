import { Coverage } from './coverage.js';
import { Random } from './random.js';
import { castRay } from './raycast.js';

/**
 * The simulator of one robot, as `sqn_jax/env/navigation.py` has it. Places and angles are rounded to single
 * precision as there: a step more or less in the last digit would soon decide otherwise at a wall.
 *
 * @typedef {object} EnvSettings the settings `env.*` of a policy by their names, all numbers and texts
 *
 * @typedef {object} Observation what the network sees, all in 0..1
 * @property {Float32Array} ranges readings over the farthest, from the rightmost beam to the leftmost
 * @property {Float32Array} goal distance and heading, as the settings encode them
 * @property {Float32Array} motion the last action, one-hot, and 1 if it was a move that was refused
 *
 * @typedef {object} Reward the terms with their weights, and their sum
 * @property {number} navigation
 * @property {number} exploration
 * @property {number} time
 * @property {number} collision
 * @property {number} total
 *
 * @typedef {object} Step
 * @property {Reward} reward
 * @property {boolean} reached whether the goal is nearer than its radius
 * @property {boolean} collision whether a move was refused
 * @property {number} freshArea newly seen, m2
 * @property {number} goalDistance m
 */

export const ACTION_NAMES = ['stand still', 'forward', 'backward', 'turn left', 'turn right'];
export const [STAND, FORWARD, BACKWARD, LEFT, RIGHT] = [0, 1, 2, 3, 4];

const single = Math.fround;
const SINGLE_PI = single(Math.PI);
const SINGLE_TURN = single(2 * Math.PI);

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
    /** @type {number[][]} m/s and rad/s of each action */
    this.commands = [
      [0, 0],
      [settings.forward_speed, 0],
      [-settings.backward_speed, 0],
      [0, settings.turn_rate],
      [0, -settings.turn_rate],
    ];
    /** @type {number[]} x m, y m, heading rad in -pi..pi */
    this.pose = [0, 0, 0];
    /** @type {number[]} x m, y m */
    this.goal = [0, 0];
    /** Angle from the first beam to the last, rad. */
    this.fieldOfView = (settings.field_of_view_deg * Math.PI) / 180;
    const lastBeam = settings.num_beams - 1;
    /** @type {Float64Array} directions of the beams from the heading, rad */
    this.beamAngles = Float64Array.from({ length: settings.num_beams }, (_, beam) =>
      single((beam / lastBeam - 0.5) * this.fieldOfView),
    );
    /** @type {Float64Array} true readings, m, from the rightmost beam to the leftmost */
    this.ranges = new Float64Array(settings.num_beams);
    /** @type {Float32Array} see `Observation` */
    this.motion = new Float32Array(this.commands.length + 1);
    /** @type {Uint8Array} 1 for the cells that the robot's center may not enter */
    this.blocked = grid.blockedFor(settings.robot_radius);
    /** @type {Coverage} */
    this.coverage = new Coverage(
      grid.width * grid.resolution,
      grid.height * grid.resolution,
      settings,
    );
    /** Steps taken since `reset`. */
    this.steps = 0;
  }

  /** The grid has been changed: what blocks the robot, and what it sees now. */
  gridChanged() {
    this.blocked = this.grid.blockedFor(this.settings.robot_radius);
    this.#scan();
  }

  /**
   * Start an episode; what the first scan sees is no reward.
   * @param {number[]} pose x m, y m, heading rad
   * @param {number[]} goal x m, y m
   */
  reset(pose, goal) {
    this.pose = pose.map(single);
    this.goal = goal.map(single);
    this.steps = 0;
    this.motion.fill(0);
    this.coverage.reset();
    this.#scan();
    this.coverage.addScan(this.pose, this.ranges);
  }

  /**
   * Advance by one time step.
   * @param {number} action 0 to 4
   * @returns {Step}
   */
  step(action) {
    const { settings } = this;
    const collision = this.#move(...this.#noisy(this.commands[action]));
    this.steps += 1;
    this.#scan();
    const freshArea = this.coverage.addScan(this.pose, this.ranges);
    const isMove = action === FORWARD || action === BACKWARD;
    this.motion.fill(0);
    this.motion[action] = 1;
    this.motion[this.commands.length] = Number(collision && isMove);
    const { distance, heading } = this.goalInRobotFrame();
    const reachable = this.#isReachable(distance, heading);
    const navigation = settings.reward_navigation * (reachable ? Math.exp(-distance) : 0);
    const exploration = settings.reward_exploration * freshArea;
    const time = -settings.reward_time;
    const refused = collision ? -settings.reward_collision : 0;
    return {
      reward: {
        ...{ navigation, exploration, time, collision: refused },
        total: navigation + exploration + time + refused,
      },
      reached: distance < single(settings.goal_radius),
      collision,
      freshArea,
      goalDistance: distance,
    };
  }

  /**
   * What the network sees now, with noise on the readings if there is any: call it once a step.
   * @returns {Observation}
   */
  observe() {
    const { settings, noise } = this;
    const relative = settings.range_noise_unit !== 'absolute';
    const ranges = Float32Array.from(this.ranges, (reading) => {
      if (noise.range === 0) return reading / settings.max_range;
      const error = noise.range * this.random.between(-1, 1);
      const observed = relative ? reading * (1 + error) : reading + settings.max_range * error;
      return Math.min(Math.max(observed / settings.max_range, 0), 1);
    });
    const { distance, heading } = this.goalInRobotFrame();
    const encoded =
      settings.goal_distance_encoding === 'rational'
        ? distance / (distance + settings.goal_distance_scale)
        : Math.min(distance / settings.max_goal_distance, 1);
    const direction =
      settings.heading_encoding === 'sincos'
        ? [(1 + Math.sin(heading)) / 2, (1 + Math.cos(heading)) / 2]
        : [(heading + Math.PI) / (2 * Math.PI)];
    const goal = Float32Array.of(encoded, ...direction);
    return { ranges, goal, motion: this.motion.slice() };
  }

  /**
   * The goal as seen from the robot.
   * @returns {{distance: number, heading: number}} m; rad in -pi..pi, 0 ahead, positive to the left
   */
  goalInRobotFrame() {
    const [x, y, heading] = this.pose;
    const [dx, dy] = [single(this.goal[0] - x), single(this.goal[1] - y)];
    const direction = single(Math.atan2(dy, dx));
    return { distance: single(Math.hypot(dx, dy)), heading: wrapSingle(direction - heading) };
  }

  /**
   * Whether the robot's center may stand at a place.
   * @param {number} x m
   * @param {number} y m
   * @returns {boolean}
   */
  isFree(x, y) {
    const [column, row] = [Math.floor(this.#inCells(x)), Math.floor(this.#inCells(y))];
    const inside = column >= 0 && row >= 0 && column < this.grid.width && row < this.grid.height;
    return inside && !this.blocked[row * this.grid.width + column];
  }

  /** A coordinate in m, in cells: rounded as in Python, which decides on which side of a border it lies. */
  #inCells(meters) {
    return single(single(meters) / single(this.grid.resolution));
  }

  /** The velocity that is executed, m/s and rad/s. */
  #noisy([speed, turnRate]) {
    const sigma = this.noise.velocity;
    if (sigma === 0) return [speed, turnRate];
    const { forward_speed, turn_rate, velocity_noise_unit } = this.settings;
    const units = velocity_noise_unit === 'absolute' ? [1, 1] : [forward_speed, turn_rate];
    return [
      speed + sigma * units[0] * this.random.normal(),
      turnRate + sigma * units[1] * this.random.normal(),
    ];
  }

  /**
   * Move for one step. A move into a blocked place is refused as a whole; the turn is made all the same.
   * @returns {boolean} whether it was refused
   */
  #move(speed, turnRate) {
    const { grid } = this;
    const timeStep = single(this.settings.time_step);
    const [x, y, heading] = this.pose;
    // Not rounded before the sum, which compiled code makes of it in one operation.
    const turn = single(turnRate) * timeStep;
    // An arc is made; its chord is what is checked.
    const narrowing = turn === 0 ? 1 : single(Math.sin(turn / 2) / (turn / 2));
    const chord = single(single(single(speed) * timeStep) * narrowing);
    const length = Math.abs(chord);
    const direction = single(heading + single(turn / 2));
    this.pose[2] = wrapSingle(heading + turn);
    if (length === 0) return false;
    const travel = single(direction + (chord < 0 ? SINGLE_PI : 0));
    const needed = single(length + 5e-4);
    const [cosine, sine] = [single(Math.cos(travel)), single(Math.sin(travel))];
    const [column, row] = [this.#inCells(x), this.#inCells(y)];
    const limit = (needed + 1e-3) / grid.resolution;
    const clear = castRay(this.blocked, grid.width, column, row, cosine, sine, limit);
    const end = [
      single(x + single(chord * single(Math.cos(direction)))),
      single(y + single(chord * single(Math.sin(direction)))),
    ];
    if (single(clear * grid.resolution) < needed || !this.isFree(...end)) return true;
    [this.pose[0], this.pose[1]] = end;
    return false;
  }

  /** Read all beams. */
  #scan() {
    const { grid } = this;
    const [x, y] = [this.#inCells(this.pose[0]), this.#inCells(this.pose[1])];
    const [cosine, sine] = [single(Math.cos(this.pose[2])), single(Math.sin(this.pose[2]))];
    const limit = this.settings.max_range / grid.resolution;
    for (let beam = 0; beam < this.ranges.length; beam += 1) {
      const angle = this.beamAngles[beam];
      const [beamCosine, beamSine] = [single(Math.cos(angle)), single(Math.sin(angle))];
      const rayCosine = single(single(cosine * beamCosine) - single(sine * beamSine));
      const raySine = single(single(sine * beamCosine) + single(cosine * beamSine));
      this.ranges[beam] =
        grid.resolution * castRay(grid.occupied, grid.width, x, y, rayCosine, raySine, limit);
    }
  }

  /** Whether the goal lies in the field of view, nearer than the reading of the beam nearest to it. */
  #isReachable(distance, heading) {
    if (Math.abs(heading) > this.fieldOfView / 2) return false;
    const lastBeam = this.ranges.length - 1;
    return distance < this.ranges[Math.round((heading / this.fieldOfView + 0.5) * lastBeam)];
  }
}

/**
 * @param {number} angle rad
 * @returns {number} the angle in -pi..pi, rounded at each step as in Python
 */
export function wrapSingle(angle) {
  const rest = single(single(angle) + SINGLE_PI) % SINGLE_TURN;
  return single((rest < 0 ? single(rest + SINGLE_TURN) : rest) - SINGLE_PI);
}
