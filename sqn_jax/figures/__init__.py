"""Pictures of recorded data, one function each: from NumPy arrays or rows to a Matplotlib figure.

No pyplot, no display, no global state: a figure belongs to nobody until `save` writes it as PNG.
"""

from sqn_jax.figures.curves import learning_curve, learning_curves
from sqn_jax.figures.gallery import map_gallery
from sqn_jax.figures.noise import robustness
from sqn_jax.figures.paths import MAX_PATHS, trajectories
from sqn_jax.figures.style import DPI, WIDTH_IN, save

__all__ = [
    "DPI",
    "MAX_PATHS",
    "WIDTH_IN",
    "learning_curve",
    "learning_curves",
    "map_gallery",
    "robustness",
    "save",
    "trajectories",
]
