// node bench.mjs PAGE.html: milliseconds a step of simulator and policy on each map of a page that
// `sqn play` wrote, and of what the page does less often.

import { readFileSync } from 'node:fs';
import { performance } from 'node:perf_hooks';
import { Env } from '../../sqn_jax/play/web/env.js';
import { unpackMap } from '../../sqn_jax/play/web/grid.js';
import { Policy } from '../../sqn_jax/play/web/network.js';
import { shortestPath } from '../../sqn_jax/play/web/paths.js';

const NUM_STEPS = 1000;

/** Milliseconds that a call takes. */
function timed(call) {
  const start = performance.now();
  call();
  return performance.now() - start;
}

const html = readFileSync(process.argv[2], 'utf8');
const data = JSON.parse(html.split('id="data">')[1].split('</script>')[0]);
for (const map of data.maps) {
  const grid = unpackMap(map);
  const env = new Env(data.policy.env, grid);
  const policy = new Policy(data.policy);
  const [start, goal] = [map.evaluation_points[0], map.evaluation_points.at(-1)];
  env.reset([...start, 1], goal);
  const steps = Array.from({ length: NUM_STEPS }, () =>
    timed(() => env.step(policy.act(env.observe()).action)),
  ).sort((a, b) => a - b);
  const path = timed(() => shortestPath(grid, env.blocked, start, goal));
  const walls = timed(() => env.gridChanged());
  const row = {
    map: map.name,
    cells: `${grid.width} x ${grid.height}`,
    median: steps[NUM_STEPS / 2],
    'of 100 the slowest': steps[NUM_STEPS * 0.99],
    mean: steps.reduce((sum, step) => sum + step, 0) / NUM_STEPS,
    'shortest path': path,
    'walls changed': walls,
  };
  const cells = Object.entries(row).map(([name, value]) =>
    typeof value === 'number' ? `${name} ${value.toFixed(2)} ms` : value,
  );
  console.log(cells.join(', '));
}
