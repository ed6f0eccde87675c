// node parity.mjs VECTORS.json: plays the episodes of `vectors.py` again and says how they differ.

import { readFileSync } from 'node:fs';
import { Env } from '../../sqn_jax/play/web/env.js';
import { unpackMap } from '../../sqn_jax/play/web/grid.js';
import { Policy } from '../../sqn_jax/play/web/network.js';
import { castRay } from '../../sqn_jax/play/web/raycast.js';

const MAX_RANGE_ERROR = 1e-4;
/** A ray of the program may pass a corner that it cuts by less than this, cells. */
const CORNER = 1e-3;
/** Rounding of places and readings, m: no point of the lattice so near to an edge is decided the same. */
const EDGE = 2e-5;

const largest = (values) => values.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
const difference = (ours, theirs) => largest([...ours].map((value, index) => value - theirs[index]));

/** Whether a reading lies between those of rays a little aside: at a corner, or along a wall. */
function isCorner(env, beam, reading) {
  const { grid, pose } = env;
  const angle = pose[2] + env.beamAngles[beam];
  const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
  const limit = env.settings.max_range / grid.resolution;
  const readings = [-CORNER, 0, CORNER].map((aside) => {
    const [x, y] = [pose[0] / grid.resolution - sine * aside, pose[1] / grid.resolution + cosine * aside];
    return castRay(grid.occupied, grid.width, x, y, cosine, sine, limit) * grid.resolution;
  });
  const [least, most] = [Math.min(...readings), Math.max(...readings)];
  return reading >= least - MAX_RANGE_ERROR && reading <= most + MAX_RANGE_ERROR;
}

/** Whether scans from one pose decide differently about a point of the lattice a little aside. */
function isEdge(coverage, { pose, scans }, column, row) {
  const [u, v] = coverage.locate(pose[0], pose[1]);
  const aside = EDGE / coverage.cell;
  const seen = [];
  for (const du of [-aside, aside]) {
    for (const dv of [-aside, aside]) {
      const [x, y] = [column - u + du, row - v + dv];
      for (const ranges of scans) seen.push(coverage.sees(x, y, pose[2] - coverage.angle, ranges));
    }
  }
  return seen.some((value) => value !== seen[0]);
}

/** The points [column, row] that one of two lists of them has and the other has not. */
function oddPoints(ours, theirs) {
  const [mine, yours] = [new Set(ours.map(String)), new Set(theirs.map(String))];
  return [
    ...ours.filter((point) => !yours.has(String(point))),
    ...theirs.filter((point) => !mine.has(String(point))),
  ];
}

function seenPoints(coverage) {
  const points = [];
  coverage.seen.forEach((seen, index) => {
    if (!seen) return;
    const column = index % coverage.columns;
    points.push([column + coverage.left, (index - column) / coverage.columns + coverage.bottom]);
  });
  return points;
}

/** How an episode differs: the largest errors, and what is not alike, ties among it. */
function play(episode, policyData, mapData) {
  const env = new Env(policyData.env, unpackMap(mapData));
  const policy = new Policy(policyData);
  const report = {
    policy: policyData.name,
    map: mapData.name,
    steps: episode.actions.length,
    poseError: 0,
    rangeError: 0,
    qError: 0,
    weightError: 0,
    rewardError: 0,
    corners: 0,
    wrongRanges: 0,
    wrongActions: [],
    wrongFlags: [],
    latePoints: 0,
    edges: 0,
    wrongPoints: 0,
  };
  const visits = [];
  const look = (step) => {
    report.poseError = Math.max(report.poseError, difference(env.pose, episode.poses[step]));
    visits.push({ pose: [...env.pose], scans: [env.ranges.slice(), episode.ranges[step]] });
    env.ranges.forEach((reading, beam) => {
      const theirs = episode.ranges[step][beam];
      const error = Math.abs(reading - theirs);
      if (error <= MAX_RANGE_ERROR) {
        report.rangeError = Math.max(report.rangeError, error);
        return;
      }
      report[isCorner(env, beam, theirs) ? 'corners' : 'wrongRanges'] += 1;
      // The network is to see the same.
      env.ranges[beam] = theirs;
    });
  };
  env.reset(episode.pose, episode.goal);
  look(0);
  for (let step = 0; step < episode.actions.length; step += 1) {
    const { action: chosen, qValues, weights } = policy.act(env.observe());
    const action = episode.at_random ? episode.actions[step] : chosen;
    report.qError = Math.max(report.qError, difference(qValues, episode.q_values[step]));
    report.weightError = Math.max(report.weightError, difference(weights, episode.skill_weights[step]));
    if (action !== episode.actions[step]) {
      report.wrongActions.push(step);
      break;
    }
    const { reward, collision, reached } = env.step(action);
    if (collision !== episode.collisions[step] || reached !== episode.reached[step]) {
      report.wrongFlags.push(step);
      break;
    }
    const { settings } = env;
    const [navigation, exploration, time, total] = episode.rewards[step];
    const theirs = [
      navigation * settings.reward_navigation,
      exploration * settings.reward_exploration,
      time * settings.reward_time,
      total,
    ];
    const ours = [reward.navigation, reward.exploration, reward.time, reward.total];
    // A point that a corner hides from one of the two is new to it later.
    const points = Math.round((ours[1] - theirs[1]) / (settings.reward_exploration * env.coverage.cell ** 2));
    const area = points * settings.reward_exploration * env.coverage.cell ** 2;
    report.latePoints += Math.abs(points);
    const rewardError = difference([ours[0], ours[1] - area, ours[2], ours[3] - area], theirs);
    report.rewardError = Math.max(report.rewardError, rewardError);
    look(step + 1);
  }
  for (const [column, row] of oddPoints(seenPoints(env.coverage), episode.covered)) {
    const isTie = visits.some((visit) => isEdge(env.coverage, visit, column, row));
    report[isTie ? 'edges' : 'wrongPoints'] += 1;
  }
  return report;
}

const { policies, maps, episodes } = JSON.parse(readFileSync(process.argv[2], 'utf8'));
const reports = episodes.map((episode) => play(episode, policies[episode.policy], maps[episode.map]));
console.log(JSON.stringify(reports));
