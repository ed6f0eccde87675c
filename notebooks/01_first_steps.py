# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # First steps: a map, a scan, a step, an episode
#
# You will learn
#
# - what a map is here, and how long its ways are,
# - what the robot knows: 71 beams and the direction and distance of its goal, no map, no position,
# - how to take a step by hand, and how `vmap` makes many robots of one,
# - how to record an episode of a trained policy, and what its pictures say.

# %%
import base64
import os
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sqn_jax
from sqn_jax import figures
from sqn_jax.env import ACTION_NAMES, NUM_ACTIONS
from sqn_jax.evaluation.recording import record
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.figures.animation import gif
from sqn_jax.maps import goal_distance, load_map, points_to_cells, traversable
from sqn_jax.policies.pretrained import find_policy

SMALL = os.environ.get("SQN_NOTEBOOKS") == "small"
EPISODES = 6 if SMALL else 100  # recorded on the maze
STEPS = 40 if SMALL else 0  # an episode; 0 is the map's own limit, 400
ROBOTS = 8 if SMALL else 1024  # side by side, to measure the speed
SEED = 1_000  # of starts and goals; the policy was trained with other ones

# %% [markdown]
# ## A map
#
# An occupancy grid: row 0 at the bottom, positions in meters from the lower left corner. Four come
# with the package; agents are trained on the maze, the others are for looking at what they make of
# a map they never saw. The numbers are the evaluation points.

# %%
names = ("maze", "column") if SMALL else ("maze", "column", "forest", "cave")
maps = [load_map(name) for name in names]
figures.picture(figures.map_gallery(maps))

# %% [markdown]
# How much longer than the straight line is the way between two evaluation points? `goal_distance`
# is the length of the shortest way over the cells a robot of 0.1 m radius fits in. A ratio near 1
# asks for nothing but to head for the goal.

# %%
rows = []
for there in maps:
    free = traversable(there.occupied, there.resolution, 0.1)
    points = there.evaluation_points
    row, column = points_to_cells(points, there.resolution).T
    path_lengths = goal_distance(free, there.resolution, points)[:, row, column]
    lines = np.linalg.norm(points[:, None] - points[None], axis=-1)
    apart = ~np.eye(len(points), dtype=bool)
    ratio = path_lengths[apart] / lines[apart]
    rows.append([there.name, f"{there.size_m[0]:g} x {there.size_m[1]:g}", f"{there.max_steps}"])
    rows[-1] += [f"{path_lengths[apart].mean():.1f}", f"{ratio.mean():.2f}", f"{ratio.max():.2f}"]
header = ["map", "size, m", "steps an episode", "mean way, m", "way / line, mean", "largest"]
print(markdown_table(header, rows))

# %% [markdown]
# ## What the robot sees
#
# `reset` draws a start and a goal. The observation has 71 readings, from the rightmost beam at -175
# degrees to the leftmost at 175, and the distance and heading of the goal; every number lies in
# 0..1.

# %%
params = sqn_jax.make_env("maze")
reset, step = jax.jit(sqn_jax.reset), jax.jit(sqn_jax.step)
obs, state = reset(jax.random.key(0), params)
x, y, heading = (float(value) for value in state.pose)
print(f"the robot is at ({x:.2f}, {y:.2f}) m, heading {np.degrees(heading):.0f} degrees,", end=" ")
print(f"its goal at ({float(state.goal[0]):.2f}, {float(state.goal[1]):.2f}) m")
print(f"{obs.ranges.size} readings, {obs.goal.size} numbers of the goal")
for name, beam in (("right", 17), ("ahead", 35), ("left", 53)):
    print(f"  {-175 + 5 * beam:4d} degrees ({name}): {float(obs.ranges[beam]):.3f}", end=" ")
    print(f"= {float(obs.ranges[beam]) * params.config.max_range:.2f} m")
distance, direction = (float(value) for value in obs.goal)
print(f"  goal: {distance:.3f} = {distance * params.config.max_goal_distance:.2f} m,", end=" ")
print(f"{direction:.3f} = {np.degrees((2 * direction - 1) * np.pi):.0f} degrees from the heading")

# %% [markdown]
# ## A step by hand
#
# A step lasts 0.1 s. It returns the next observation and state, the reward, whether the episode was
# `terminated` (never: reaching the goal does not end it) or `truncated` (its time is up), and what
# the reward was made of.

# %%
print(dict(enumerate(ACTION_NAMES)))
for action in (1, 3):
    obs, state, reward, terminated, truncated, info = step(jax.random.key(1), state, action, params)
    print(f"{ACTION_NAMES[action]}: reward {float(reward):.2f}", end=" = ")
    print(f"2 x {float(info['reward_navigation']):.2f} for the goal", end=" + ")
    print(f"{float(info['reward_exploration']):.2f} for what is newly seen", end=" + ")
    print(f"0.2 x {float(info['reward_time']):g} for the time,", end=" ")
    print(f"move refused: {bool(info['collision'])}")

# %% [markdown]
# ## Many robots
#
# Everything is written for one robot; `vmap` makes many of it, `scan` many steps, `jit` one
# program. The first call compiles and is not counted; `block_until_ready` waits for the result,
# since JAX returns before it is there. Random actions; coverage and reward are part of a step.

# %%
LENGTH = 10 if SMALL else 100


@partial(jax.jit, static_argnames="robots")
def act_randomly(key, params, *, robots):
    """Move robots at random for LENGTH steps; returns their mean reward a step."""
    start_key, rollout_key = jax.random.split(key)
    _, states = jax.vmap(sqn_jax.reset, in_axes=(0, None))(
        jax.random.split(start_key, robots), params
    )

    def advance(states, key):
        action_key, step_key = jax.random.split(key)
        actions = jax.random.randint(action_key, (robots,), 0, NUM_ACTIONS)
        _, states, rewards, *_ = jax.vmap(sqn_jax.step, in_axes=(0, 0, 0, None))(
            jax.random.split(step_key, robots), states, actions, params
        )
        return states, rewards.mean()

    return jnp.mean(jax.lax.scan(advance, states, jax.random.split(rollout_key, LENGTH))[1])


begun = time.perf_counter()
jax.block_until_ready(act_randomly(jax.random.key(0), params, robots=ROBOTS))
print(f"first call, with compilation: {time.perf_counter() - begun:.1f} s")
speeds = []
for repeat in range(1, 6):
    begun = time.perf_counter()
    mean_reward = jax.block_until_ready(act_randomly(jax.random.key(repeat), params, robots=ROBOTS))
    speeds.append(ROBOTS * LENGTH / (time.perf_counter() - begun))
print(f"{ROBOTS} robots, {LENGTH} steps, 5 times: median {np.median(speeds):,.0f} steps a second")
print(f"slowest {min(speeds):,.0f}, fastest {max(speeds):,.0f}, on {jax.devices()[0].platform}")
print(f"mean reward a step of random actions: {float(mean_reward):.2f}")

# %% [markdown]
# ## An episode of a trained policy
#
# `record` drives a policy greedily and keeps everything that happened, as NumPy arrays. The tasks
# are those of `sqn evaluate` under the same seed.

# %%
policy = find_policy("pretrained:sqn")
episodes = record(policy, "maze", episodes=EPISODES, seed=SEED, max_steps=STEPS)
reached = [episode for episode in episodes if episode.success]
print(f"{len(reached)} of {len(episodes)} reached the goal", end="; ")
print(f"time steps, failures at the limit: mean {np.mean([e.time_steps for e in episodes]):.0f}")
rewards = np.concatenate([episode.rewards for episode in episodes])
print(f"mean reward a step: {rewards.mean():.2f}")

# %% [markdown]
# From here on one of them, the median success in time steps. First its readings at four places, in
# the robot's own frame: that is all it knows of the maze.

# %%
by_time = sorted(reached or episodes, key=lambda episode: episode.time_steps)
episode = by_time[len(by_time) // 2]
figures.picture(figures.observation_patterns([episode], title="What the robot sees"))

# %% [markdown]
# Then the whole episode over time: the weights of the two skills, the Q-values, the reward by
# parts, the distance to the goal.

# %%
figures.picture(figures.episode_timeline(episode, title="An episode on the maze"))

# %% [markdown]
# And as a film. Plain Python passes over the last line; in a notebook it plays.

# %%


class Film:
    """An animated GIF that a notebook plays."""

    def __init__(self, data):
        self.data = data

    def __repr__(self):
        return f"Film of {len(self.data) / 1e3:.0f} kB"

    def _repr_html_(self):
        encoded = base64.b64encode(self.data).decode("ascii")
        return f'<img alt="The episode as a film" src="data:image/gif;base64,{encoded}"/>'


Film(gif(episode, count=4 if SMALL else 80, width_px=500))

# %% [markdown]
# ## Finding
#
# - The maze is the map that asks for more than heading for the goal: the way between evaluation
#   points is 1.72 times the straight line there, 1.01 on the column map and 1.08 in the forest. The
#   cave asks for as much of that, 1.92, over 110.1 m.
# - Random actions lose reward, -0.09 a step; the trained policy gets 1.22 a step and reaches 96 of
#   100 goals, in 171 steps on average with failures at the limit. This is one training seed.
# - The speed printed above is that of the machine this was run on, beside other work; yours will
#   differ.
# - In the episode drawn, the second skill has nearly all of the weight all the way. What weights
#   mean is the subject of the next notebook, on `pretrained:best`, whose gate moves more.
