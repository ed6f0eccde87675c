"""Figures of recorded data: each function takes arrays or rows and returns a Matplotlib figure.

No pyplot, no display, no global state. `save` writes a figure as PNG, `picture` shows it in a
notebook. Animations are made by `frames`, `gif` and `mp4`.
"""

from sqn_jax.figures.animation import frames, gif, mp4
from sqn_jax.figures.commands import commands
from sqn_jax.figures.curves import gate_entropy_curves, learning_curve, learning_curves
from sqn_jax.figures.differences import paired_differences
from sqn_jax.figures.episode import coverage_example, reachability_example
from sqn_jax.figures.gallery import map_gallery, map_picture, observation_patterns
from sqn_jax.figures.network import network_architecture
from sqn_jax.figures.noise import robustness
from sqn_jax.figures.paths import MAX_PATHS, trajectories
from sqn_jax.figures.skills import agents_on_maps, agents_side_by_side, skill_trajectories
from sqn_jax.figures.style import DPI, WIDTH_IN, Picture, picture, save
from sqn_jax.figures.timeline import episode_timeline

__all__ = [
    "DPI",
    "MAX_PATHS",
    "WIDTH_IN",
    "Picture",
    "agents_on_maps",
    "agents_side_by_side",
    "commands",
    "coverage_example",
    "episode_timeline",
    "frames",
    "gate_entropy_curves",
    "gif",
    "learning_curve",
    "learning_curves",
    "map_gallery",
    "map_picture",
    "mp4",
    "network_architecture",
    "observation_patterns",
    "paired_differences",
    "picture",
    "reachability_example",
    "robustness",
    "save",
    "skill_trajectories",
    "trajectories",
]
