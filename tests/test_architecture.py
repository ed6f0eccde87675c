"""What the contracts of import-linter (pyproject.toml) cannot say: where jit, plotting and I/O may
stand, what is never used, how long a file and a function may get; and that the contracts hold.

The rules are read off the source (`ast`); nothing is imported. Every checker takes the root of a
tree, so that it is itself tested on small trees with one fault planted in each.
"""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "sqn_jax"
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 80

QUIET = ("sqn_jax/env/", "sqn_jax/agent/", "sqn_jax/training/rollout.py")
"""Where nothing is read, written or said."""
QUIET_IMPORTS = {
    *("datetime", "io", "logging", "os", "shutil", "subprocess", "sys", "tempfile", "time", "tqdm")
}
QUIET_CALLS = {
    *("breakpoint", "input", "open", "print", "read_bytes", "read_text", "write_bytes"),
    *("write_text", "io_callback", "block_until_ready"),
}
PLOTTING_LIBRARIES = {"imageio", "matplotlib"}
PLOTTING = ("sqn_jax/figures/", "sqn_jax/report/")
JIT = (
    *("sqn_jax/training/loop.py", "sqn_jax/training/exported.py"),
    *("sqn_jax/evaluation/baseline_episodes.py", "sqn_jax/evaluation/episodes.py"),
    *("sqn_jax/evaluation/recording.py", "sqn_jax/evaluation/settings.py"),
    *("sqn_jax/policies/greedy.py", "sqn_jax/export/rollout.py", "sqn_jax/adapters/programs.py"),
    *("experiments/bench_simulator.py", "experiments/bench_learner.py"),
    *("experiments/bench_adapters.py", "examples/purejaxrl_ppo.py"),
    "sqn_jax/env/loops.py",  # `traced_once` is inlined: it compiles nothing of its own.
    *("experiments/bench_breakdown.py", "experiments/check_gpu.py", "notebooks/01_first_steps.py"),
)
"""Files that make compiled programs; jit elsewhere would nest and hide what compiles."""
JIT_NAMES = {"jit", "pjit", "pmap", "exported_jit"}
UNSAFE_IMPORTS = {
    *("cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"),
    *("ftplib", "http", "requests", "socket", "urllib"),
}
UNSAFE_CALLS = {"eval", "exec", "compile", "__import__", "unsafe_load"}


class Source:
    """One file of the tree: its path and its syntax tree."""

    def __init__(self, root: Path, path: Path) -> None:
        self.path = path.relative_to(root).as_posix()
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text, filename=self.path)

    def at(self, node: ast.AST, fault: str) -> str:
        """A line that an editor can jump to."""
        return f"{self.path}:{getattr(node, 'lineno', 1)}: {fault}"

    def is_in(self, places: tuple[str, ...]) -> bool:
        """Whether the file is one of `places`, or in a folder of them."""
        return self.path.startswith(places)


def sources(root: Path) -> list[Source]:
    """The files that the rules hold for; tests may do as they like."""
    folders = (PACKAGE, "experiments", "notebooks", "examples")
    return [Source(root, p) for folder in folders for p in sorted((root / folder).rglob("*.py"))]


def libraries(source: Source) -> Iterator[tuple[ast.AST, str]]:
    """Every import, wherever in the file, as (node, top-level package)."""
    for node in ast.walk(source.tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        for name in names:
            yield node, name.split(".")[0]


def misplaced_libraries(root: Path) -> Iterator[str]:
    """Plotting outside its rooms, I/O where all is pure, unsafe libraries anywhere."""
    for source in sources(root):
        for node, library in libraries(source):
            if library in UNSAFE_IMPORTS:
                yield source.at(node, f"{library} is not to be used anywhere")
            if library in PLOTTING_LIBRARIES and not source.is_in(PLOTTING):
                yield source.at(node, f"{library} belongs in {' or '.join(PLOTTING)}")
            if library in QUIET_IMPORTS and source.is_in(QUIET):
                yield source.at(node, f"no I/O here: may not import {library}")


def misplaced_calls(root: Path) -> Iterator[str]:
    """I/O where all is pure; eval and unpickling anywhere."""
    for source in sources(root):
        for node in ast.walk(source.tree):
            if not isinstance(node, ast.Call):
                continue
            function = node.func
            name = getattr(function, "id", getattr(function, "attr", None))
            if name in QUIET_CALLS and source.is_in(QUIET):
                yield source.at(node, f"no I/O here: may not call {name}")
            # re.compile and jitted.compile are other things than compile.
            if name in UNSAFE_CALLS and (isinstance(function, ast.Name) or name == "unsafe_load"):
                yield source.at(node, f"{name} is not to be used anywhere")
            for keyword in node.keywords:
                if keyword.arg == "allow_pickle" and ast.unparse(keyword.value) != "False":
                    yield source.at(node, "allow_pickle is not to be used anywhere")


def misplaced_jit(root: Path) -> Iterator[str]:
    """jit elsewhere than around whole programs, where it would nest and hide what compiles."""
    for source in sources(root):
        if source.is_in(JIT):
            continue
        for node in ast.walk(source.tree):
            names = set()
            if isinstance(node, ast.Attribute):
                names = {node.attr}
            elif isinstance(node, ast.ImportFrom):
                names = {alias.name for alias in node.names}
            for name in sorted(names & JIT_NAMES):
                yield source.at(node, f"{name} belongs in {', '.join(JIT)}")


def oversized(root: Path) -> Iterator[str]:
    """Files and functions too long to be read in one go."""
    for source in sources(root):
        lines = len(source.text.splitlines())
        if lines > MAX_FILE_LINES and source.path.startswith(f"{PACKAGE}/"):
            yield f"{source.path}:1: {lines} lines, at most {MAX_FILE_LINES} allowed"
        for node in ast.walk(source.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    fault = f"{node.name} has {lines} lines, at most {MAX_FUNCTION_LINES} allowed"
                    yield source.at(node, fault)


CHECKERS = (misplaced_libraries, misplaced_calls, misplaced_jit, oversized)

# A small tree in which every rule is used and none broken.
CLEAN_TREE = {
    "sqn_jax/cli.py": "import sys\nprint(1)\n",
    "sqn_jax/maps/ros.py": "import re\nopen('x')\nre.compile('x')\n",
    "sqn_jax/env/geometry.py": "import jax.numpy as jnp\n",
    "sqn_jax/agent/loss.py": "import jax\n",
    "sqn_jax/training/rollout.py": "import jax\n",
    "sqn_jax/training/loop.py": "import time\nimport jax\nx = jax.jit(abs)\n",
    "sqn_jax/figures/paths.py": "def draw():\n    from matplotlib import pyplot\n",
    "experiments/bench_learner.py": "import jax\nimport sqn_jax\njax.jit(abs)\n",
}
LONG_FILE = "x = 1\n" * (MAX_FILE_LINES + 1)
LONG_FUNCTION = "def f():\n" + "    x = 1\n" * MAX_FUNCTION_LINES

# (file, what is written there, a part of the fault that is to be found)
FAULTS = [
    ("sqn_jax/training/loop.py", "import matplotlib.pyplot as plt", "matplotlib belongs in"),
    ("experiments/benchmark.py", "import imageio", "imageio belongs in"),
    ("sqn_jax/training/rollout.py", "import jax\nf = jax.jit(abs)", "jit belongs in"),
    ("sqn_jax/agent/loss.py", "import jax\n@jax.jit\ndef f(): ...", "jit belongs in"),
    ("sqn_jax/agent/loss.py", "from jax import jit as fast", "jit belongs in"),
    ("sqn_jax/env/geometry.py", "print(1)", "may not call print"),
    ("sqn_jax/env/geometry.py", "import jax\njax.debug.print('x')", "may not call print"),
    ("sqn_jax/agent/loss.py", "open('x')", "may not call open"),
    ("sqn_jax/training/rollout.py", "from time import monotonic", "may not import time"),
    ("sqn_jax/training/loop.py", "import pickle", "pickle is not to be used"),
    ("experiments/benchmark.py", "from urllib.request import urlopen", "urllib is not to be used"),
    ("sqn_jax/cli.py", "eval('1')", "eval is not to be used"),
    ("sqn_jax/cli.py", "import numpy as np\nnp.load('x', allow_pickle=True)", "allow_pickle"),
    ("sqn_jax/cli.py", "import yaml\nyaml.unsafe_load('1')", "unsafe_load is not to be used"),
    ("sqn_jax/cli.py", LONG_FILE, "at most 400 allowed"),
    ("experiments/benchmark.py", LONG_FUNCTION, "f has 81 lines, at most 80 allowed"),
]


def write_tree(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")


def faults(root: Path) -> list[str]:
    return [fault for checker in CHECKERS for fault in checker(root)]


@pytest.mark.parametrize("checker", CHECKERS, ids=lambda checker: checker.__name__)
def test_the_source_keeps_to_the_rules(checker):
    assert len(sources(ROOT)) > 10, "the source was not found"
    assert list(checker(ROOT)) == []


def test_a_clean_tree_has_no_fault(tmp_path):
    write_tree(tmp_path, CLEAN_TREE)
    assert faults(tmp_path) == []


@pytest.mark.parametrize(("path", "text", "expected"), FAULTS)
def test_a_planted_fault_is_found_where_it_stands(tmp_path, path, text, expected):
    write_tree(tmp_path, CLEAN_TREE)
    write_tree(tmp_path, {path: text})
    found = faults(tmp_path)
    assert len(found) == 1, found
    assert expected in found[0]
    assert path in found[0]


def test_files_and_functions_at_the_limit_are_allowed(tmp_path):
    function = LONG_FUNCTION.removesuffix("    x = 1\n")
    file = LONG_FILE.removesuffix("x = 1\n")
    write_tree(tmp_path, CLEAN_TREE | {"sqn_jax/cli.py": file, "experiments/report.py": function})
    assert faults(tmp_path) == []


def check_imports(root: Path) -> subprocess.CompletedProcess[str]:
    """What `make lint` asks of import-linter, for the tree at `root`."""
    code = "import sys, importlinter.cli as c; sys.exit(c.lint_imports(no_cache=True))"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False
    )


def test_packages_import_each_other_as_the_contracts_say():
    checked = check_imports(ROOT)
    assert checked.returncode == 0, checked.stdout


# (file, an import that has no business there)
WRONG_IMPORTS = [
    ("env/geometry.py", "import sqn_jax.agent.loss"),
    ("env/reward.py", "from sqn_jax.maps import load_map"),
    ("agent/loss.py", "from sqn_jax.env import step"),
    ("config/run.py", "from sqn_jax.maps import load_map"),
    ("maps/ros.py", "import jax"),
    ("training/rollout.py", "from sqn_jax.maps import load_map"),
    ("baselines/bug.py", "from sqn_jax.training import rollout"),
    ("storage/files.py", "from sqn_jax.runs import progress"),
    ("figures/paths.py", "from sqn_jax.evaluation import compare"),
    ("evaluation/scores.py", "def f():\n    from sqn_jax import figures"),
    ("training/loop.py", "from sqn_jax.cli import main"),
]


def test_a_wrong_import_breaks_a_contract(tmp_path):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    shutil.copytree(ROOT / PACKAGE, tmp_path / PACKAGE, ignore=shutil.ignore_patterns("weights"))
    for name, line in WRONG_IMPORTS:
        path = tmp_path / PACKAGE / name
        path.write_text(f"{path.read_text()}\n{line}\n")
    checked = check_imports(tmp_path)
    assert checked.returncode == 1
    for name, line in WRONG_IMPORTS:
        module = f"{PACKAGE}.{name.removesuffix('.py').replace('/', '.')}"
        number = len((tmp_path / PACKAGE / name).read_text().splitlines())
        assert f"{module} -> " in checked.stdout, (module, line)
        assert f"(l.{number})" in checked.stdout, (module, line)
