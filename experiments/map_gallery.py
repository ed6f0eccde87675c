"""Draw the picture of the maps in the README: python experiments/map_gallery.py"""

from __future__ import annotations

from pathlib import Path

from sqn_jax import figures
from sqn_jax.maps import load_map
from sqn_jax.presets import PAPER_MAPS

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "maps.png"


def main() -> None:
    """Write docs/images/maps.png."""
    maps = [load_map(name) for name in PAPER_MAPS]
    figures.save(figures.map_gallery(maps), OUT)
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main()
