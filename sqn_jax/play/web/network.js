import { decodeBase64 } from './grid.js';
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

/** That of `flax.linen.LayerNorm`. */
const LAYER_NORM_EPSILON = 1e-6;

export class Policy {
  /**
   * @param {PolicyData} data
   * @param {Random} random for epsilon
   */
  constructor(data, random = new Random(0)) {
    this.name = data.name;
    this.algo = data.algo;
    this.settings = data.network;
    this.random = random;
    this.arrays = unpackArrays(data);
    /** Skills; 1 for a network without. */
    this.numSkills = data.algo === 'sqn' ? data.network.num_skills : 1;
    this.hidden = new Float32Array(data.network.hidden_size);
  }

  /** Forget: the start of an episode. */
  reset() {
    this.hidden = new Float32Array(this.hidden.length);
  }

  /**
   * Take one step.
   * @param {Observation} observation from `env.observe()`
   * @param {number} epsilon probability of a random action
   * @returns {Decision} its arrays are not changed by later steps
   */
  act(observation, epsilon = 0) {
    const perception = this.#perceive(this.#features(observation));
    const { weights, skillQValues } = this.#heads(perception);
    const qValues = new Float32Array(skillQValues[0].length);
    for (let action = 0; action < qValues.length; action += 1) {
      let value = 0;
      for (let skill = 0; skill < weights.length; skill += 1) {
        value += weights[skill] * skillQValues[skill][action];
      }
      qValues[action] = value;
    }
    const explored = epsilon > 0 && this.random.uniform() < epsilon;
    const best = qValues.indexOf(Math.max(...qValues));
    const action = explored ? this.random.integer(qValues.length) : best;
    return { action, qValues, weights, skillQValues, hidden: perception, explored };
  }

  /** The features of ranges and goal, each through an MLP of its own, and the motion as it is (eq. 1). */
  #features(observation) {
    const ranges = this.#mlp('features/ranges', observation.ranges);
    const goal = this.#mlp('features/goal', observation.goal);
    const motion = this.settings.motion_inputs ? observation.motion : [];
    return Float32Array.of(...ranges, ...goal, ...motion);
  }

  /** What the heads see: the next hidden state (eq. 2), or the layer of a DQN. */
  #perceive(features) {
    if (this.algo === 'dqn') {
      return rectify(this.#normalized('norm', this.#linear('perception', features)));
    }
    const refined = this.settings.cell === 'refined_gru';
    this.hidden = refined ? this.#refinedGru(features) : this.#gru(features);
    return this.hidden;
  }

  /** The skill weights (eq. 3, 4) and the action values of each skill (eq. 5), or a single head. */
  #heads(perception) {
    if (this.algo !== 'sqn') {
      return { weights: Float32Array.of(1), skillQValues: [this.#mlp('skill_0', perception)] };
    }
    const embedded = (name) => {
      const embedding = this.arrays[`${name}_embedding`].values;
      return this.#mlp(name, perception.map((value, unit) => value + embedding[unit]));
    };
    const skills = Array.from({ length: this.numSkills }, (_, skill) => `skill_${skill}`);
    return { weights: softmax(embedded('decision')), skillQValues: skills.map(embedded) };
  }

  /** The next hidden state of a gated recurrent unit, the gates in the order of `agent/gru.py`: r, z, n. */
  #gru(features) {
    const size = this.hidden.length;
    const projected = this.#affine('perception/input_kernel', 'perception/input_bias', features);
    const recurrent = this.#affine('perception/hidden_kernel', null, this.hidden);
    const bias = this.arrays['perception/candidate_bias'].values;
    return this.hidden.map((before, unit) => {
      const [second, third] = [size + unit, 2 * size + unit];
      const reset = sigmoid(projected[unit] + recurrent[unit]);
      const update = sigmoid(projected[second] + recurrent[second]);
      const candidate = Math.tanh(projected[third] + reset * (recurrent[third] + bias[unit]));
      return (1 - update) * candidate + update * before;
    });
  }

  /** The next hidden state of the unit of `agent/refined_gru.py`, in its order r, z, i, n, s. */
  #refinedGru(features) {
    const size = this.hidden.length;
    const projected = this.#affine('perception/input_kernel', 'perception/input_bias', features);
    const recurrent = this.#affine('perception/hidden_kernel', null, this.hidden);
    const bias = this.arrays['perception/candidate_bias'].values;
    return this.hidden.map((before, unit) => {
      const at = [0, 1, 2, 3, 4].map((part) => part * size + unit);
      const gate = (part) => sigmoid(projected[at[part]] + recurrent[at[part]]);
      const [reset, update, refine] = [gate(0), gate(1), gate(2)];
      const inner = projected[at[3]] + reset * (recurrent[at[3]] + bias[unit]);
      const candidate = Math.tanh(projected[at[4]] * inner);
      const blend = refine * (1 - (1 - update) ** 2) + (1 - refine) * update ** 2;
      return (1 - blend) * candidate + blend * before;
    });
  }

  /** Two linear layers with a ReLU in between, layer-normalized before it where the policy is so. */
  #mlp(path, inputs) {
    const hidden = this.#normalized(`${path}/norm`, this.#linear(`${path}/hidden`, inputs));
    return this.#linear(`${path}/output`, rectify(hidden));
  }

  #linear(path, inputs) {
    return this.#affine(`${path}/kernel`, `${path}/bias`, inputs);
  }

  /** Layer normalization, where the policy has parameters for it. */
  #normalized(path, inputs) {
    if (!(`${path}/scale` in this.arrays)) return inputs;
    const [scale, bias] = [this.arrays[`${path}/scale`].values, this.arrays[`${path}/bias`].values];
    let [sum, squares] = [0, 0];
    for (const value of inputs) sum += value;
    const mean = sum / inputs.length;
    for (const value of inputs) squares += (value - mean) ** 2;
    const deviation = Math.sqrt(squares / inputs.length + LAYER_NORM_EPSILON);
    return inputs.map((value, unit) => ((value - mean) / deviation) * scale[unit] + bias[unit]);
  }

  /** The product of inputs [D] and a kernel [D, E], plus a bias [E] if there is one. */
  #affine(kernelPath, biasPath, inputs) {
    const kernel = this.arrays[kernelPath];
    const [numInputs, numOutputs] = kernel.shape;
    if (inputs.length !== numInputs) {
      throw new Error(`${kernelPath} takes ${numInputs} numbers, here are ${inputs.length}`);
    }
    const sums = new Float64Array(numOutputs);
    if (biasPath) sums.set(this.arrays[biasPath].values);
    const { values } = kernel;
    for (let input = 0; input < numInputs; input += 1) {
      const value = inputs[input];
      if (value === 0) continue;
      const row = input * numOutputs;
      for (let output = 0; output < numOutputs; output += 1) {
        sums[output] += value * values[row + output];
      }
    }
    return Float32Array.from(sums);
  }
}

/**
 * The arrays of a policy by their paths.
 * @param {PolicyData} data
 * @returns {Object<string, {shape: number[], values: Float32Array}>}
 */
function unpackArrays(data) {
  const bytes = decodeBase64(data.weights);
  const numbers = decodeHalves(bytes);
  const arrays = {};
  let first = 0;
  for (const [path, shape] of Object.entries(data.shapes)) {
    const size = shape.reduce((product, length) => product * length, 1);
    arrays[path] = { shape, values: numbers.subarray(first, first + size) };
    first += size;
  }
  if (first !== numbers.length) throw new Error(`weights are ${numbers.length}, expected ${first}`);
  return arrays;
}

/**
 * @param {Uint8Array} bytes little-endian float16, two bytes a number
 * @returns {Float32Array}
 */
export function decodeHalves(bytes) {
  const numbers = new Float32Array(bytes.length / 2);
  for (let index = 0; index < numbers.length; index += 1) {
    const bits = bytes[2 * index] | (bytes[2 * index + 1] << 8);
    const [exponent, mantissa] = [(bits >> 10) & 31, bits & 1023];
    // Exponent 0 is for numbers below the smallest with a leading 1. Infinity is never written.
    const size = exponent === 0 ? mantissa * 2 ** -24 : (1024 + mantissa) * 2 ** (exponent - 25);
    numbers[index] = bits >> 15 ? -size : size;
  }
  return numbers;
}

const sigmoid = (value) => 1 / (1 + Math.exp(-value));

const rectify = (values) => values.map((value) => Math.max(value, 0));

function softmax(logits) {
  const largest = Math.max(...logits);
  const powers = logits.map((logit) => Math.exp(logit - largest));
  const sum = powers.reduce((total, power) => total + power, 0);
  return powers.map((power) => power / sum);
}
