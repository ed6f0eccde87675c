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
# # Noise that was never trained with
#
# The paper drives its agents, trained without noise on the maze, under noise on the velocity and on
# the readings. You will learn
#
# - how success and time steps change over the paper's levels, for the policies that come with the
#   package and for a wall follower (`bug`) that sees what they see,
# - whether any of the differences is larger than its interval,
# - where on the map an agent fails under noise,
# - how this stands to the paper's numbers.

# %%
import os
from collections import Counter

import numpy as np

from sqn_jax import figures
from sqn_jax.evaluation.agents import BaselineAgent, TrainedAgent
from sqn_jax.evaluation.compare import evaluate_agents, load_maps
from sqn_jax.evaluation.scores import markdown_table
from sqn_jax.evaluation.settings import Settings
from sqn_jax.policies.pretrained import find_policy, pretrained_names

SMALL = os.environ.get("SQN_NOTEBOOKS") == "small"
EPISODES = 6 if SMALL else 200  # of each agent at each level
STEPS = 40 if SMALL else 0  # an episode; 0 is the map's own limit, 400
SEED = 1_000  # of starts, goals and noise
QUIET = (0.0, 0.0)
VELOCITY = [(level, 0.0) for level in (0.1, 0.2, 0.3)]
RANGES = [(0.0, level) for level in (0.2, 0.4, 0.6)]
NOISES = [QUIET, VELOCITY[-1], RANGES[-1]] if SMALL else [QUIET, *VELOCITY, *RANGES]

# %% [markdown]
# ## What the levels mean
#
# The paper names no units. Here, sigma of the Gaussian velocity noise is a share of full speed (0.1
# is 0.25 m/s and 0.31 rad/s, drawn anew every 0.1 s), and a reading is multiplied by 1 + U(-p, p),
# then cut at the sensor's reach. Noise on the readings is seen by the agent only: the reward and
# the simulator know the truth.
#
# Every agent meets the same starts, goals and noise. They drive between the evaluation points of
# the maze; an episode has 400 steps.

# %%
names = ["sqn"] if SMALL else [n for n in ("sqn", "r2d2", "dqn") if n in pretrained_names()]
policies = {name: find_policy(f"pretrained:{name}") for name in names}
robot = policies["sqn"].config.env
agents = [TrainedAgent(name, (policy,)) for name, policy in policies.items()]
if not SMALL:
    agents.append(BaselineAgent("bug", robot))
for name, policy in policies.items():
    config = policy.config
    print(f"{name}: trained on {config.map} for {config.total_episodes:,} episodes,", end=" ")
    print(f"seed {config.seed}, velocity noise {config.env.velocity_noise:g},", end=" ")
    print(f"range noise {config.env.range_noise:g}")

# %% [markdown]
# ## Success over the levels

# %%
batches = {}


def keep(batch):
    """Keep the episodes for the pictures below."""
    batches[batch.agent.name, batch.world.noise] = batch


settings = Settings(
    ("maze",),
    episodes=EPISODES,
    eval_seeds=1,
    seed=SEED,
    noise=tuple(NOISES),
    goal_radii=(0.3,),
    max_steps=STEPS,
)
maps = load_maps(agents, settings)
fields = ("info", "output")
found, _ = evaluate_agents(agents, maps, settings, on_evaluated=keep, fields=fields)
figures.picture(
    figures.robustness(
        found["results"], title=f"Success on the maze under noise, {EPISODES} episodes a point"
    )
)

# %% [markdown]
# Success with its 95 % Wilson interval over episodes (one training seed an agent: how much seeds
# differ is not in it), and time steps with failures at the limit, with a bootstrap interval; a new
# run has both over routes and tasks. The paper gives numbers for its SQN only in words: "up to 0.2
# ... 0.97", "up to 0.85" at 0.3, "up to 40 % ... 0.96", "exceeding 0.80" at 60 %, and "below 0.70"
# for both baselines at 0.3.

# %%
PAPER = {
    QUIET: "0.98",
    (0.2, 0.0): "0.97",
    (0.3, 0.0): "0.85",
    (0.0, 0.4): "0.96",
    (0.0, 0.6): "> 0.80",
}


def level_name(noise):
    """A word for a pair of noises."""
    parts = [f"velocity {noise[0]:g}"] * (noise[0] > 0) + [f"range {noise[1]:.0%}"] * (noise[1] > 0)
    return parts[0] if parts else "none"


def interval(statistics, digits):
    """Mean and 95 % interval of an entry of the evaluation."""
    low, high = statistics["ci95"]
    return f"{statistics['mean']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


rows = []
for entry in found["results"]:
    noise = (entry["velocity_noise"], entry["range_noise"])
    rows.append([level_name(noise), entry["agent"], interval(entry["success"], 3)])
    rows[-1] += [interval(entry["time_steps"], 0), f"{entry['collisions']['mean']:.1f}"]
    rows[-1].append(PAPER.get(noise, "-") if entry["agent"] == "sqn" else "-")
print(f"{EPISODES} episodes a row, seed {SEED}")
header = ["noise", "agent", "success", "time steps", "refused moves", "paper"]
print(markdown_table(header, rows))

# %% [markdown]
# ## Is a difference more than luck?
#
# Each episode is compared with itself: the same start and goal without noise. Lost is a task solved
# without noise and not with it, gained the other way round; the p-value is that of the sign test
# over these (McNemar, exact). Six levels are tested an agent, so that one p-value of 0.05 among
# them is to be expected now and then.

# %%


def sign_test(lost, gained):
    """Two-sided p-value of `lost` against `gained` under a fair coin."""
    from scipy import stats

    return stats.binomtest(lost, lost + gained).pvalue if lost + gained else 1.0


rows = []
for agent in agents:
    before = batches[agent.name, QUIET].main_metrics.success
    for noise in NOISES[1:]:
        after = batches[agent.name, noise].main_metrics.success
        lost, gained = int(np.sum(before & ~after)), int(np.sum(~before & after))
        rows.append([agent.name, level_name(noise), f"{lost}", f"{gained}"])
        p_value = sign_test(lost, gained)
        rows[-1].append(f"{p_value:.4f}" if p_value >= 1e-4 else "< 0.0001")
print(markdown_table(["agent", "noise", "lost", "gained", "p"], rows))

# %% [markdown]
# ## Where it fails
#
# The SQN under the strongest noise of both kinds: two goals, the one with most failures among them;
# failures are drawn first.

# %%
there = maps["maze", robot.robot_radius]


def failures(agent, noise):
    """A picture of an agent's paths under some noise, failures first."""
    batch = batches[agent, noise]
    figure = figures.trajectories(
        there,
        batch.goals,
        batch.trajectory.poses,
        batch.trajectory.output.skill_weights,
        batch.main_metrics.success,
        batch.main_metrics.time_steps,
        goal_radius=0.3,
        title=f"{agent}, noise: {level_name(noise)}",
        robot_radius=robot.robot_radius,
        max_panels=2,
    )
    return figures.picture(figure)


failures("sqn", VELOCITY[-1])

# %%
failures("sqn", RANGES[-1])

# %% [markdown]
# The failures of the SQN by pair of evaluation points, and how near the goal they came.

# %%


def point_number(place):
    """The number, from 1, of the evaluation point at a place."""
    return int(np.linalg.norm(there.evaluation_points - place, axis=1).argmin()) + 1


for number, (x, y) in enumerate(there.evaluation_points, start=1):
    print(f"point {number}: ({x:.1f}, {y:.1f}) m")
for noise in (QUIET, VELOCITY[-1], RANGES[-1]):
    batch = batches["sqn", noise]
    lost = np.flatnonzero(~batch.main_metrics.success)
    pairs = Counter(
        f"{point_number(batch.starts[e, :2])} to {point_number(batch.goals[e])}" for e in lost
    )
    nearest = batch.trajectory.info["goal_distance"][:, lost].min(axis=0)
    most_common = ", ".join(f"{pair}: {count}" for pair, count in pairs.most_common(5)) or "none"
    print(f"{level_name(noise)}: {len(lost)} of {EPISODES} failed; {most_common}", end="")
    print(f"; nearest to the goal, median {np.median(nearest):.1f} m" if len(lost) else "")

# %% [markdown]
# ## Finding
#
# 200 tasks a level on the maze, one training seed an agent: nothing is said of how much seeds
# differ.
#
# - **Velocity noise costs the trained agents nothing.** SQN has 0.970 [0.936, 0.986] without it
#   and 0.980 [0.950, 0.992] at 0.3; R2D2 0.940 and 0.990, DQN 0.980 and 0.955. No loss is more
#   than luck by the sign test; R2D2 gains, at 0.2 (p 0.0034, which stands against six tests) and
#   at 0.3 (p 0.0129, which does not): perhaps noise gets it out of circles. DQN takes 194 steps at
#   0.3 instead of 178, SQN 171 instead of 165, R2D2 170 instead of 178, all with intervals that
#   overlap.
# - **Range noise tells the agents apart at 60 %.** SQN keeps 0.975 [0.943, 0.989], R2D2 has 0.915
#   [0.868, 0.946], DQN falls from 0.980 to 0.880 [0.828, 0.918]: 23 tasks lost, 3 gained, p below
#   0.0001. The intervals of SQN and DQN do not touch, those of SQN and R2D2 barely do.
# - **The paper's gap under velocity noise is not there.** There both baselines fall below 0.70 at
#   0.3; here R2D2 is level with SQN, 0.990 and 0.980, and DQN has 0.955. Only under range noise is
#   SQN ahead of both at every level. SQN is level with the paper at 0.2 and 40 %, 0.990 [0.964,
#   0.997] and 0.985 [0.957, 0.995] against 0.97 and 0.96, and above its 0.85 at 0.3; of 60 % the
#   paper says "exceeding 0.80". It names no unit, so that its noise may be stronger or weaker than
#   this one.
# - **The wall follower breaks where the policies do not.** 0.590 without noise, 0.515 at the
#   strongest velocity noise, but 0.065 at 20 % range noise and next to nothing above. It takes
#   every reading at its word; the policies were never trained with noise either, and still drive
#   through most of it.
# - **What fails is spread.** SQN fails in 2 to 6 of 200 tasks at any level, on different ways;
#   nearest to the goal, half of its failures came within 5.7 m without noise, within 1.9 m under
#   the strongest range noise.
