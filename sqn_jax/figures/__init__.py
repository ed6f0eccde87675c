"""Pictures of recorded data, one function each: from NumPy arrays or rows to a Matplotlib figure.

No pyplot, no display, no global state: a figure belongs to nobody until `save` writes it as PNG.
"""

from sqn_jax.figures.comparisons import learning_curves, robustness
from sqn_jax.figures.gallery import map_gallery
from sqn_jax.figures.runs import DPI, MAX_PATHS, WIDTH_IN, learning_curve, save, trajectories

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
