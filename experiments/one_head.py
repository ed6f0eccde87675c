"""An R2D2 out of one skill: python experiments/one_head.py RUN|pretrained:NAME --out NAME.npz

Writes the policy of the R2D2 agent that does what one skill of an SQN does alone, with the same
perception: `sqn train --algo r2d2 --start-from NAME.npz` then shows whether it needs the others.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from experiments.common import run
from sqn_jax.policies.interventions import single_head
from sqn_jax.policies.pretrained import SUFFIX, find_policy, write_policy


def main() -> None:
    """Read the policy, write the one that is left of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy", metavar="RUN|pretrained:NAME")
    parser.add_argument("--skill", type=int, default=1, help="which, from 1 (default 1)")
    parser.add_argument("--out", type=Path, required=True, help="a file NAME.npz; .json beside it")
    options = parser.parse_args()
    if options.out.suffix != SUFFIX or not options.out.parent.is_dir():
        parser.error(f"--out is {options.out}, expected a file NAME{SUFFIX} in an existing folder")
    policy = find_policy(options.policy)
    left = dataclasses.replace(single_head(policy, options.skill - 1), name=options.out.stem)
    write_policy(options.out.parent, left, {"skill": options.skill, "of": policy.name})
    print(f"wrote {options.out} and {options.out.with_suffix('.json')}")


if __name__ == "__main__":
    run(main)
