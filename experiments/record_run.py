"""Keep what finished runs came to: python experiments/record_run.py RUN_DIR... --out FILE.json

Writes one JSON file with, for each run folder, its summary, its settings, the final evaluation and
a learning curve thinned to about fifty rows, and all its points in evaluation. Numbers in the
README come from such files.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from sqn_jax.config import to_public_dict
from sqn_jax.storage.metrics import evaluated_rows
from sqn_jax.storage.run_folder import RunFolder

CURVE = (
    *("episodes", "wall_seconds", "updates", "mean_reward", "success", "epsilon", "loss"),
    *("gate_entropy", "skill_distance", "skill_usage"),
)
POINTS = ("eval_mean_reward", "eval_success", "eval_time_steps")
CURVE_ROWS = 50


def record(path: Path) -> dict[str, Any]:
    """What one run folder came to.

    Raises:
        ValueError: the folder holds no finished run.
    """
    folder, config = RunFolder.open(path)
    if not (path / "summary.json").is_file():
        raise ValueError(f"run folder {path}: not finished, expected a summary.json in it")
    rows = folder.read_metrics()
    selected = rows[:: max(1, len(rows) // CURVE_ROWS)] + rows[-1:]
    return {
        "run": path.name,
        "summary": json.loads((path / "summary.json").read_text(encoding="utf-8")),
        "evaluation": json.loads((path / "evaluation.json").read_text(encoding="utf-8"))["results"],
        "config": to_public_dict(config),
        "curve": [{name: row[name] for name in CURVE} for row in selected],
        "eval_curve": [
            {name: row[name] for name in ("episodes", *POINTS)} for row in evaluated_rows(rows)
        ],
    }


def main() -> None:
    """Parse the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("run_dirs", nargs="+", type=Path)
    parser.add_argument("--command", default="", help="how the runs were started, for the record")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    try:
        runs = [record(path) for path in options.run_dirs]
    except ValueError as error:
        parser.exit(2, f"record_run: {error}\n")
    data = {"command": options.command, "runs": runs}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
