"""Running the page's JavaScript without a browser, where there is Node.js."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
NODE = shutil.which("node")

needs_node = pytest.mark.skipif(
    NODE is None, reason="Node.js (node) is not installed: the page's JavaScript was not run"
)


def run_node(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Node's output; nothing is checked."""
    assert NODE is not None
    return subprocess.run(
        [NODE, *arguments], cwd=HERE, capture_output=True, text=True, check=False, timeout=120
    )


def answer(script: str, question: Any, folder: Path) -> Any:
    """What a script of this folder prints about a question, both of them JSON."""
    file = folder / "question.json"
    file.write_text(json.dumps(question))
    ended = run_node(script, str(file))
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)
