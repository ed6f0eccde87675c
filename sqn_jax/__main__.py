"""`python -m sqn_jax` is the same as the command `sqn`."""

from __future__ import annotations

from sqn_jax.cli import run

if __name__ == "__main__":
    run()
