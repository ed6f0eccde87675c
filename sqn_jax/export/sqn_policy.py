"""A trained policy of sqn_jax on Python 3.8 or newer with NumPy, and nothing else.

policy = Policy("params.safetensors")  # config.json beside it; or NAME.npz and NAME.json
command, hidden = policy.act(ranges, distance, heading, hidden)  # [v m/s, w rad/s] for time_step s
Ranges: m along `policy.beam_angles` (rad, left is positive), inf or NaN where nothing is hit. Goal:
m and rad, NaN: wait. Hidden: None at each new goal. Refused (if motion_size): a move moved nothing.
"""

import json
from pathlib import Path

import numpy as np


class Policy:
    def __init__(self, path):
        path, npz = Path(path), Path(path).suffix == ".npz"
        settings = path.with_suffix(".json") if npz else path.with_name("config.json")
        self.config = json.loads(settings.read_text(encoding="utf-8"))["config"]
        arrays = np.load(str(path)) if npz else self.read_safetensors(path.read_bytes())
        self.arrays = {name.replace("params/", "", 1): arrays[name] for name in arrays}
        self.env, self.agent, network = [self.config[key] for key in ("env", "algo", "network")]
        self.size, self.motion_size = network["hidden_size"], 5 * network.get("motion_inputs", 0)
        self.time_step, half = self.env["time_step"], np.radians(self.env["field_of_view_deg"]) / 2
        self.beam_angles = np.linspace(-half, half, self.env["num_beams"])
        v, back, w = [self.env[key] for key in ("forward_speed", "backward_speed", "turn_rate")]
        self.commands = np.array([[0, 0], [v, 0], [-back, 0], [0, w], [0, -w]], "f4")

    def read_safetensors(self, data):
        start = 8 + int.from_bytes(data[:8], "little")
        header = json.loads(data[8:start].decode("utf-8"))
        cut = {name: data[start:][slice(*header[name]["data_offsets"])] for name in header}
        return {key: np.frombuffer(cut[key], "<f4").reshape(header[key]["shape"]) for key in cut}

    def act(self, ranges, distance, heading, hidden=None, refused=None):
        more = [float(refused)] if self.motion_size else []  # None is a TypeError.
        hidden = np.zeros(self.size + self.motion_size) if hidden is None else hidden
        q_values, _, after = self.step(np.append(ranges, [distance, heading, *more]), hidden)
        return self.commands[q_values.argmax()], hidden if np.isnan(q_values[0]) else after

    def step(self, obs, hidden):  # obs [R + 2 or 3] -> Q-values [5], skill weights [K], hidden
        x = self.features(np.asarray(obs, "f4"), last=hidden[self.size :])
        hidden = hidden[: self.size] if self.agent == "dqn" else self.gru(x, hidden[: self.size])
        x = np.maximum(self.linear("perception/", x, "norm"), 0) if self.agent == "dqn" else hidden
        logits = self.mlp("decision", x) if self.agent == "sqn" else np.zeros(1, "f4")
        weights = np.exp(logits - logits.max()) / np.exp(logits - logits.max()).sum()
        q = weights @ [self.mlp("skill_" + str(skill), x) for skill in range(weights.size)]
        return q, weights, np.append(hidden, np.eye(5, dtype="f4")[q.argmax(), : self.motion_size])

    def features(self, obs, last):  # Last: the action before, one-hot, where it is an input.
        ranges, distance, heading, refused = np.split(obs, self.env["num_beams"] + np.arange(3))
        ranges = np.clip(np.where(np.isnan(ranges), np.inf, ranges) / self.env["max_range"], 0, 1)
        turns = (heading + np.pi) / (2 * np.pi)
        seen = {"linear": [np.where(abs(turns - 0.5) > 0.5, turns - np.floor(turns), turns)]}
        seen["sincos"] = [(1 + np.sin(heading)) / 2, (1 + np.cos(heading)) / 2]
        seen["clipped"] = [np.clip(distance / self.env["max_goal_distance"], 0, 1)]
        seen["rational"] = [1 - 1 / (1 + distance / self.env.get("goal_distance_scale", 1))]
        parts = seen[self.env.get("goal_distance_encoding", "clipped")]
        goal = np.concatenate(parts + seen[self.env["heading_encoding"]])
        x = [self.mlp("features/ranges", ranges), self.mlp("features/goal", goal), last]
        return np.concatenate([*x, refused * last[1:3].sum()])

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
