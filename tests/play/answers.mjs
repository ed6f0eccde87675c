// node answers.mjs QUESTIONS.json: what the page's modules say, for Python to compare with its own.

import { readFileSync } from 'node:fs';
import { Env } from '../../sqn_jax/play/web/env.js';
import { packMap, unpackMap } from '../../sqn_jax/play/web/grid.js';
import { Policy } from '../../sqn_jax/play/web/network.js';
import { shortestPath } from '../../sqn_jax/play/web/paths.js';

/** Random numbers that were drawn elsewhere, one after the other. */
class Drawn {
  constructor(numbers) {
    this.numbers = numbers;
  }

  normal() {
    return this.numbers.shift();
  }

  between() {
    return this.numbers.shift();
  }
}

const ANSWERS = {
  /** Which cells are blocked for a radius, their parts, and paths between places. */
  grid({ map, radius, tasks }) {
    const grid = unpackMap(map);
    const blocked = grid.blockedFor(radius);
    const { labels, sizes } = grid.components(blocked);
    const paths = tasks.map(([from, to]) => shortestPath(grid, blocked, from, to));
    return { blocked: [...blocked], labels: [...labels], sizes, paths, cells: packMap(grid) };
  },

  /** Where moves of given velocities end, m/s and rad/s, and which are refused. */
  moves({ settings, map, poses, velocities }) {
    const env = new Env({ ...settings, velocity_noise_unit: 'absolute' }, unpackMap(map));
    env.noise.velocity = 1;
    return poses.map((pose, index) => {
      env.reset(pose, [1, 1]);
      env.random = new Drawn([...velocities[index]]);
      const { collision } = env.step(0);
      return { pose: env.pose, collision, motion: [...env.motion] };
    });
  },

  /** What the network sees at a pose under noise on the readings. */
  observation({ settings, map, pose, goal, noise, draws }) {
    const env = new Env(settings, unpackMap(map), new Drawn([...draws]));
    env.noise.range = noise;
    env.reset(pose, goal);
    const { ranges, goal: seen } = env.observe();
    return { readings: [...env.ranges], ranges: [...ranges], goal: [...seen] };
  },

  /** What a network says of observations one after the other. */
  network({ policy, observations }) {
    const network = new Policy(policy);
    return observations.map((lists) => {
      const arrays = Object.entries(lists).map(([name, list]) => [name, Float32Array.from(list)]);
      const decision = network.act(Object.fromEntries(arrays));
      const { action, qValues, weights, hidden } = decision;
      return { action, q_values: [...qValues], skill_weights: [...weights], hidden: [...hidden] };
    });
  },
};

const questions = JSON.parse(readFileSync(process.argv[2], 'utf8'));
const answers = questions.map(({ about, ...question }) => ANSWERS[about](question));
console.log(JSON.stringify(answers));
