import { Random } from './random.js';

/**
 * A trained policy: SQN with any number of skills, R2D2 or DQN, as `sqn_jax/agent/networks.py` has them.
 *
 * @typedef {object} PolicyData what `policy_data.py` writes
 * @property {string} name
 * @property {string} algo sqn, r2d2 or dqn
 * @property {object} env the settings `env.*`, for `Env`
 * @property {object} network the settings `network.*`
 * @property {Object<string, number[]>} shapes of the arrays, in the order of `weights`
 * @property {string} weights base64 of all arrays, one after the other, as little-endian float16
 *
 * @typedef {object} Decision
 * @property {number} action 0 to 4
 * @property {Float32Array} qValues [A] action values
 * @property {Float32Array} weights [K] skill weights, which sum to 1; one of 1 without skills
 * @property {Float32Array[]} skillQValues [K][A] action values of each skill
 * @property {Float32Array} hidden [H] recurrent state after the step; the features' layer of a DQN
 * @property {boolean} explored whether epsilon has drawn the action
 */

export class Policy {
  /**
   * @param {PolicyData} data
   * @param {Random} random for epsilon
   */
  constructor(data, random = new Random(0)) {
    throw new Error('to come');
    this.name = data.name;
    this.numSkills = 1;
  }

  /** Forget: the start of an episode. */
  reset() {}

  /**
   * Take one step.
   * @param {Observation} observation from `env.observe()`
   * @param {number} epsilon probability of a random action
   * @returns {Decision} its arrays are not changed by later steps
   */
  act(observation, epsilon = 0) {}
}
