"""Train sb3-contrib's RecurrentPPO in the simulator: somebody else's learner, unchanged.

python examples/sb3_recurrent_ppo.py --out curve.json

Needs the extra `sb3`. As the training goes on, the policy is evaluated from the evaluation points
of the map, in the same tasks every time, with actions drawn as in training: PPO's policies are
random by nature. The curve is printed, and written to `--out`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

try:
    import torch
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as missing:
    print(f"sb3_recurrent_ppo: {missing.name} is missing, expected the extra sb3", file=sys.stderr)
    raise SystemExit(2) from None

from sqn_jax.adapters.sb3 import NavigationVecEnv
from sqn_jax.storage.files import probe_file

FOUR_ROOMS = f"{Path(__file__).with_name('four_rooms.map')}@0.25"
"""A map of 6 x 6 m, and its scale in m a cell."""

NETWORK = {
    "lstm_hidden_size": 128,
    "shared_lstm": True,
    "enable_critic_lstm": False,
    "net_arch": {"pi": [128], "vf": [128]},
}


def evaluate(model: RecurrentPPO, envs: NavigationVecEnv) -> dict[str, float]:
    """Success and mean reward a step of an episode in each env."""
    envs.seed(1_000)
    obs, memory = envs.reset(), None
    starts = np.ones(envs.num_envs, bool)
    rewards = []
    while True:
        actions, memory = model.predict(obs, memory, starts)
        obs, reward, starts, infos = envs.step(actions)
        rewards.append(reward)
        if starts.all():
            success = np.mean([info["is_success"] for info in infos])
            return {"eval_success": float(success), "eval_mean_reward": float(np.mean(rewards))}


class Curve(BaseCallback):
    """Evaluates before the training and after every few rollouts."""

    def __init__(self, envs: NavigationVecEnv, every: int) -> None:
        super().__init__()
        self.envs, self.every = envs, every
        self.rows: list[dict[str, float]] = []
        self.rollouts = 0
        self.seconds_evaluating = 0.0
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:  # The update on the rollout before is done.
        if self.rollouts % self.every == 0:
            self.note()
        self.rollouts += 1

    def _on_training_end(self) -> None:
        self.note()

    def note(self) -> None:
        """Add a row, and print it."""
        begun = time.perf_counter()
        row = evaluate(self.model, self.envs)
        wall_seconds = begun - self.started - self.seconds_evaluating
        self.seconds_evaluating += time.perf_counter() - begun
        steps = self.num_timesteps
        episodes = steps / self.envs.get_attr("env_params")[0].max_steps
        row |= {"episodes": episodes, "env_steps": steps, "wall_seconds": round(wall_seconds, 1)}
        self.rows.append(row)
        print(
            f"{steps:>9,} steps  {wall_seconds:6.1f} s  success {row['eval_success']:.2f}  "
            f"reward {row['eval_mean_reward']:.3f}",
            flush=True,
        )


def train(options: argparse.Namespace) -> list[dict[str, float]]:
    """Train; returns the points of the curve."""
    torch.set_num_threads(options.threads)
    limit = {"max_steps": options.max_steps}
    envs = NavigationVecEnv(options.map, options.num_envs, **limit)
    tests = NavigationVecEnv(options.map, options.eval_episodes, spawn="evaluation", **limit)
    curve = Curve(tests, options.eval_every)
    model = RecurrentPPO(
        "MlpLstmPolicy",
        envs,
        n_steps=options.rollout_steps,
        batch_size=options.rollout_steps * options.num_envs // 4,
        n_epochs=4,
        learning_rate=lambda left: 1e-3 * left,
        gamma=0.99,
        gae_lambda=0.95,
        ent_coef=0.01,
        policy_kwargs=NETWORK,
        seed=options.seed,
        device="cpu",
    )
    model.learn(options.steps, callback=curve)
    return curve.rows


def main() -> None:
    """Parse the arguments, train, write the curve."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--map", default=FOUR_ROOMS, help="as for sqn train")
    parser.add_argument("--max-steps", type=int, default=200, help="of an episode")
    parser.add_argument("--steps", type=int, default=819_200, help="of all envs together")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--rollout-steps", type=int, default=128, help="steps between updates")
    parser.add_argument("--eval-episodes", type=int, default=100)
    parser.add_argument("--eval-every", type=int, default=10, help="rollouts")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write the curve here, as JSON")
    options = parser.parse_args()
    for name, value in vars(options).items():
        if isinstance(value, int) and name != "seed" and value < 1:
            option = name.replace("_", "-")
            parser.exit(2, f"sb3_recurrent_ppo: --{option} is {value}, expected 1 or more\n")
    if options.rollout_steps * options.num_envs < 8:
        parser.exit(2, "sb3_recurrent_ppo: expected 8 or more steps of all envs between updates\n")
    try:
        if options.out is not None:
            probe_file(options.out)
        rows = train(options)
    except ValueError as error:
        parser.exit(2, f"sb3_recurrent_ppo: {error}\n")
    if options.out is not None:
        command = " ".join(["python examples/sb3_recurrent_ppo.py", *sys.argv[1:]])
        data = {"command": command, "trainer": "RecurrentPPO", "curve": rows}
        options.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
