"""A trained policy of sqn_jax on Python 3.8 or newer with NumPy, and nothing else.

policy = Policy("params.safetensors")  # config.json beside it; or NAME.npz and NAME.json
command, hidden = policy.act(ranges, distance, heading, hidden)  # [v m/s, w rad/s] for time_step s

Ranges: m along `policy.beam_angles` (rad, left is positive), inf or NaN where nothing is hit.
Goal: m and rad; where it is NaN the robot waits, and hidden stays. None at each new goal.
"""

import json
from pathlib import Path

import numpy as np


def read_safetensors(path):
    data = path.read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start].decode("utf-8"))
    numbers = np.frombuffer(data[start:], "<f4")
    ends = {name: [end // 4 for end in header[name]["data_offsets"]] for name in header}
    return {name: numbers[slice(*ends[name])].reshape(header[name]["shape"]) for name in header}


class Policy:
    def __init__(self, path):
        path, npz = Path(path), Path(path).suffix == ".npz"
        settings = path.with_suffix(".json") if npz else path.with_name("config.json")
        self.config = json.loads(settings.read_text(encoding="utf-8"))["config"]
        arrays = np.load(str(path)) if npz else read_safetensors(path)
        self.arrays = {name.replace("params/", "", 1): arrays[name] for name in arrays}
        self.env, self.agent = self.config["env"], self.config["algo"]
        half = np.radians(self.env["field_of_view_deg"]) / 2
        self.beam_angles = np.linspace(-half, half, self.env["num_beams"])
        self.time_step, back = self.env["time_step"], -self.env["backward_speed"]
        v, w = self.env["forward_speed"], self.env["turn_rate"]
        self.commands = np.array([[0, 0], [v, 0], [back, 0], [0, w], [0, -w]], "f4")

    def act(self, ranges, distance, heading, hidden=None):
        hidden = np.zeros(self.config["network"]["hidden_size"]) if hidden is None else hidden
        q_values, _, after = self.step(np.append(ranges, [distance, heading]), hidden)
        return self.commands[q_values.argmax()], hidden if np.isnan(q_values[0]) else after

    def step(self, obs, hidden):  # obs [R + 2] -> Q-values [5], skill weights [K], hidden [H]
        ranges, goal = self.inputs(np.asarray(obs, "f4"), self.env["max_range"])
        x = np.append(self.mlp("features/ranges", ranges), self.mlp("features/goal", goal))
        hidden = hidden if self.agent == "dqn" else self.gru(x, hidden)
        x = np.maximum(self.linear("perception/", x, "norm"), 0) if self.agent == "dqn" else hidden
        logits = self.mlp("decision", x) if self.agent == "sqn" else np.zeros(1, "f4")
        weights = np.exp(logits - logits.max()) / np.exp(logits - logits.max()).sum()
        q_values = np.array([self.mlp("skill_" + str(skill), x) for skill in range(weights.size)])
        return weights @ q_values, weights, hidden

    def inputs(self, obs, far):
        ranges = np.clip(np.where(np.isnan(obs[:-2]), far, obs[:-2]) / far, 0, 1)
        distance, heading = np.clip(obs[-2:-1] / self.env["max_goal_distance"], 0, 1), obs[-1:]
        turns = (heading + np.pi) / (2 * np.pi)
        parts = [np.where(abs(turns - 0.5) > 0.5, turns - np.floor(turns), turns)]
        if self.env["heading_encoding"] == "sincos":
            parts = [(1 + np.sin(heading)) / 2, (1 + np.cos(heading)) / 2]
        return ranges, np.concatenate([distance, *parts])

    def mlp(self, name, x):
        x = x + self.arrays.get(name + "_embedding", 0)
        x = np.maximum(self.linear(name + "/hidden/", x, norm=name + "/norm"), 0)
        return self.linear(name + "/output/", x)

    def linear(self, name, x, norm=""):
        x = x @ self.arrays[name + "kernel"] + self.arrays[name + "bias"]
        if norm + "/scale" in self.arrays:
            x = (x - x.mean()) / np.sqrt(x.var() + 1e-6) * self.arrays[norm + "/scale"]
            x = x + self.arrays[norm + "/bias"]
        return x

    def gru(self, x, hidden):
        reset, update, new = np.split(self.linear("perception/input_", x), 3)
        to_reset, to_update, inner = np.split(hidden @ self.arrays["perception/hidden_kernel"], 3)
        reset, update = [(1 + np.tanh(g / 2)) / 2 for g in (reset + to_reset, update + to_update)]
        new = np.tanh(new + reset * (inner + self.arrays["perception/candidate_bias"]))
        return np.float32(new + update * (hidden - new))
