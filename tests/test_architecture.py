"""Who may import whom, where jit, plotting and I/O may stand, and how long a file may get.

The rules are read off the source (`ast`); nothing is imported. Every checker takes the root of a
tree, so that it is itself tested on small trees with one fault planted in each.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "sqn_jax"
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 80

# A room is a module or package directly below sqn_jax; the package's own __init__ is the room
# "sqn_jax", and all scripts together are "experiments". What is not listed is not allowed; a new
# room is entered here, on its layer.
RUN_LAYER = {
    "adapters",
    "bug",
    "checkpoint",
    "compare",
    "divergence",
    "evaluate",
    "export",
    "figures",
    "interventions",
    "lock",
    "manifest",
    "memory",
    "navigators",
    "paper",
    "planners",
    "policies",
    "pretrained",
    "progress",
    "recording",
    "render",
    "report",
    "runlog",
    "scores",
    "statistics",
    "tensorboard",
    "train",
}
DEVICE_LAYER = {"checks", "config", "devices", "presets", "env", "agent", "rollout"}
ARROWS: dict[str, set[str]] = {
    "checks": set(),
    "config": {"checks"},
    "presets": {"config"},
    "maps": set(),
    "devices": {"config"},
    "env": {"config"},
    "agent": {"config"},
    "rollout": {"config", "env", "agent"},
    **{room: RUN_LAYER | DEVICE_LAYER | {"maps"} for room in RUN_LAYER},
    "sqn_jax": RUN_LAYER | DEVICE_LAYER | {"maps"},
    "paper": {"config", "presets"},
    # Known to session, render and report only: who imports the library gets no cache on disk.
    "compilation": {"runlog"},
    "render": RUN_LAYER | DEVICE_LAYER | {"maps", "compilation"},
    "report": RUN_LAYER | DEVICE_LAYER | {"maps", "compilation"},
    "finish": RUN_LAYER | DEVICE_LAYER | {"maps", "sqn_jax"},
    "manifest": RUN_LAYER | DEVICE_LAYER | {"sqn_jax"},
    "session": RUN_LAYER | DEVICE_LAYER | {"maps", "finish", "signals", "compilation"},
    "signals": set(),
    "cli": RUN_LAYER | DEVICE_LAYER | {"maps", "session", "signals", "sqn_jax"},
    "__main__": {"cli"},
    "experiments": RUN_LAYER | DEVICE_LAYER | {"maps", "session", "signals", "sqn_jax"},
    "notebooks": RUN_LAYER | DEVICE_LAYER | {"maps", "sqn_jax"},
}
# env meets maps in one module: the one that makes EnvParams.
EXTRA_ARROWS = {"sqn_jax.env.prepare": {"maps"}}

QUIET_ROOMS = {"env", "agent", "rollout"}
QUIET_IMPORTS = {
    *("datetime", "io", "logging", "os", "shutil", "subprocess", "sys", "tempfile", "time", "tqdm")
}
QUIET_CALLS = {
    *("breakpoint", "input", "open", "print", "read_bytes", "read_text", "write_bytes"),
    *("write_text", "io_callback", "block_until_ready"),
}
DEVICE_LIBRARIES = {"chex", "flax", "jax", "jaxlib", "optax", "orbax"}
PLOTTING_LIBRARIES = {"imageio", "matplotlib"}
PLOTTING_ROOMS = {"figures", "render"}
JIT_MODULES = {
    *("sqn_jax.train", "sqn_jax.evaluate", "sqn_jax.recording", "sqn_jax.devices"),
    *("experiments.bench_simulator", "experiments.bench_learner", "experiments.bench_breakdown"),
    "experiments.check_gpu",
    "notebooks.01_first_steps",
}
JIT_NAMES = {"jit", "pjit", "pmap"}
UNSAFE_IMPORTS = {
    *("cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"),
    *("ftplib", "http", "requests", "socket", "urllib"),
}
UNSAFE_CALLS = {"eval", "exec", "compile", "__import__", "unsafe_load"}


class Source:
    """One file of the tree: its dotted name, its room and its syntax tree."""

    def __init__(self, root: Path, path: Path) -> None:
        self.path = path.relative_to(root).as_posix()
        parts = path.relative_to(root).with_suffix("").parts
        self.is_package = parts[-1] == "__init__"
        self.module = ".".join(parts[:-1] if self.is_package else parts)
        self.room = room_of(self.module)
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text, filename=self.path)

    def at(self, node: ast.AST, fault: str) -> str:
        """A line that an editor can jump to."""
        return f"{self.path}:{getattr(node, 'lineno', 1)}: {fault}"


def room_of(module: str) -> str:
    """The room of a dotted module name; for one from elsewhere, its top-level package."""
    first, *rest = module.split(".")
    return rest[0] if first == PACKAGE and rest else first


def sources(root: Path) -> list[Source]:
    """The files that the rules hold for; tests may do as they like."""
    folders = (PACKAGE, "experiments", "notebooks")
    return [Source(root, p) for folder in folders for p in sorted((root / folder).rglob("*.py"))]


def is_ours(module: str) -> bool:
    return module.split(".")[0] in (PACKAGE, "experiments", "notebooks")


def is_allowed(source: Source, target: str) -> bool:
    """Whether a file may import a module of ours."""
    rooms = ARROWS.get(source.room, set()) | EXTRA_ARROWS.get(source.module, set())
    return room_of(target) in rooms | {source.room}


def imports(source: Source, modules: set[str]) -> Iterator[tuple[ast.AST, str]]:
    """Every import, wherever in the file, as (node, dotted name of the module that is meant).

    `from package import name` means package.name where that is one of `modules`.
    """
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                depth = node.level - source.is_package
                parts = source.module.split(".")
                base = ".".join([*parts[: len(parts) - depth], *base.split(".")]).rstrip(".")
            for alias in node.names:
                name = f"{base}.{alias.name}"
                yield node, name if name in modules else base


def wrong_arrows(root: Path) -> Iterator[str]:
    """Imports from a room that the importing room may not know."""
    files = sources(root)
    modules = {source.module for source in files}
    for source in files:
        if source.room not in ARROWS:
            yield source.at(source.tree, f"the room {source.room} has no place in ARROWS")
            continue
        for node, target in imports(source, modules):
            if is_ours(target) and not is_allowed(source, target):
                yield source.at(node, f"{source.room} may not import {target}")


def import_cycles(root: Path) -> Iterator[str]:
    """Modules that import each other, at whatever distance, along arrows that are allowed."""
    files = sources(root)
    modules = {source.module for source in files}
    graph = {s.module: {t for _, t in imports(s, modules) if is_allowed(s, t)} for s in files}
    # Whatever imports nothing that is left cannot be on a cycle.
    while free := [module for module, targets in graph.items() if not targets & graph.keys()]:
        for module in free:
            del graph[module]
    if graph:
        yield f"these import each other, or what does: {', '.join(sorted(graph))}"


def misplaced_libraries(root: Path) -> Iterator[str]:
    """Device libraries on the host side, plotting outside its two rooms, unsafe ones anywhere."""
    for source in sources(root):
        for node, target in imports(source, set()):
            library = room_of(target)
            if is_ours(target):
                continue
            if library in UNSAFE_IMPORTS:
                yield source.at(node, f"{library} is not to be used anywhere")
            if library in PLOTTING_LIBRARIES and source.room not in PLOTTING_ROOMS:
                yield source.at(node, f"{library} belongs in {' or '.join(sorted(PLOTTING_ROOMS))}")
            if library in DEVICE_LIBRARIES and source.room == "maps":
                yield source.at(node, f"maps is host-only and may not import {library}")
            if library in QUIET_IMPORTS and source.room in QUIET_ROOMS:
                yield source.at(node, f"{source.room} does no I/O and may not import {library}")


def misplaced_calls(root: Path) -> Iterator[str]:
    """I/O below train; eval and unpickling anywhere."""
    for source in sources(root):
        for node in ast.walk(source.tree):
            if not isinstance(node, ast.Call):
                continue
            function = node.func
            name = getattr(function, "id", getattr(function, "attr", None))
            if name in QUIET_CALLS and source.room in QUIET_ROOMS:
                yield source.at(node, f"{source.room} does no I/O and may not call {name}")
            # re.compile and jitted.compile are other things than compile.
            if name in UNSAFE_CALLS and (isinstance(function, ast.Name) or name == "unsafe_load"):
                yield source.at(node, f"{name} is not to be used anywhere")
            for keyword in node.keywords:
                if keyword.arg == "allow_pickle" and ast.unparse(keyword.value) != "False":
                    yield source.at(node, "allow_pickle is not to be used anywhere")


def misplaced_jit(root: Path) -> Iterator[str]:
    """jit elsewhere than around whole programs, where it would nest and hide what compiles."""
    for source in sources(root):
        if source.module in JIT_MODULES:
            continue
        for node in ast.walk(source.tree):
            names = set()
            if isinstance(node, ast.Attribute):
                names = {node.attr}
            elif isinstance(node, ast.ImportFrom):
                names = {alias.name for alias in node.names}
            for name in sorted(names & JIT_NAMES):
                yield source.at(node, f"{name} belongs in {', '.join(sorted(JIT_MODULES))}")


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


CHECKERS = (
    wrong_arrows,
    import_cycles,
    misplaced_libraries,
    misplaced_calls,
    misplaced_jit,
    oversized,
)

# A small tree in which every rule is used and none broken.
CLEAN_TREE = {
    "sqn_jax/__init__.py": "from sqn_jax.env import make_env\n",
    "sqn_jax/__main__.py": "from sqn_jax.cli import main\n",
    "sqn_jax/cli.py": "import sys\nfrom sqn_jax import __version__, train\nprint(__version__)\n",
    "sqn_jax/config.py": "import json\n",
    "sqn_jax/maps/__init__.py": "from sqn_jax.maps.ros import load_map\n",
    "sqn_jax/maps/ros.py": "import re\nimport numpy\nopen('x')\nre.compile('x')\n",
    "sqn_jax/env/__init__.py": "from .prepare import make_env\n",
    "sqn_jax/env/geometry.py": "import jax.numpy as jnp\n",
    "sqn_jax/env/prepare.py": "from . import geometry\nfrom sqn_jax.maps import load_map\n",
    "sqn_jax/agent/__init__.py": "",
    "sqn_jax/agent/loss.py": "import jax\nfrom sqn_jax.config import LearnerConfig\n",
    "sqn_jax/rollout.py": "from sqn_jax.agent import loss\nfrom sqn_jax.env import step\n",
    "sqn_jax/train.py": "import time\nimport jax\nfrom sqn_jax import rollout\nx = jax.jit(abs)\n",
    "sqn_jax/compilation.py": "import os\nimport jax\n",
    "sqn_jax/session.py": "from sqn_jax import compilation, train\n",
    "sqn_jax/evaluate.py": "from jax import jit\nfrom sqn_jax.rollout import unroll\n",
    "sqn_jax/figures.py": "def draw():\n    from matplotlib import pyplot\n",
    "experiments/bench_learner.py": "import jax\nimport sqn_jax\njax.jit(abs)\n",
}
LONG_FILE = "x = 1\n" * (MAX_FILE_LINES + 1)
LONG_FUNCTION = "def f():\n" + "    x = 1\n" * MAX_FUNCTION_LINES

# (file, what is written there, a part of the fault that is to be found)
FAULTS = [
    ("sqn_jax/env/geometry.py", "from sqn_jax.agent import loss", "env may not import sqn_jax.a"),
    ("sqn_jax/env/geometry.py", "import sqn_jax.agent.loss as l", "env may not import sqn_jax.a"),
    ("sqn_jax/env/geometry.py", "from ..agent.loss import f", "env may not import sqn_jax.agent"),
    ("sqn_jax/env/geometry.py", "from .. import train", "env may not import sqn_jax.train"),
    ("sqn_jax/env/__init__.py", "from ..maps import load_map", "env may not import sqn_jax.maps"),
    ("sqn_jax/env/geometry.py", "def f():\n    import sqn_jax.train", "env may not import"),
    ("sqn_jax/env/geometry.py", "from sqn_jax.maps import ros", "env may not import sqn_jax.maps"),
    ("sqn_jax/env/geometry.py", "import sqn_jax", "env may not import sqn_jax"),
    ("sqn_jax/agent/loss.py", "from sqn_jax.env import step", "agent may not import sqn_jax.env"),
    ("sqn_jax/agent/loss.py", "from sqn_jax import rollout", "agent may not import sqn_jax.roll"),
    ("sqn_jax/agent/loss.py", "from sqn_jax.maps import ros", "agent may not import sqn_jax.maps"),
    ("sqn_jax/rollout.py", "from sqn_jax.train import run", "rollout may not import sqn_jax.tra"),
    ("sqn_jax/rollout.py", "from sqn_jax.maps import ros", "rollout may not import sqn_jax.maps"),
    ("sqn_jax/config.py", "from sqn_jax.env import step", "config may not import sqn_jax.env"),
    ("sqn_jax/train.py", "from sqn_jax.cli import main", "train may not import sqn_jax.cli"),
    ("sqn_jax/train.py", "from sqn_jax import compilation", "train may not import sqn_jax.compil"),
    ("sqn_jax/cli.py", "from sqn_jax import compilation", "cli may not import sqn_jax.compil"),
    ("sqn_jax/cli.py", "from experiments import benchmark", "cli may not import experiments"),
    ("sqn_jax/maps/ros.py", "from sqn_jax.env import step", "maps may not import sqn_jax.env"),
    ("sqn_jax/maps/ros.py", "import jax.numpy as jnp", "maps is host-only and may not import jax"),
    ("sqn_jax/maps/ros.py", "from flax import struct", "maps is host-only and may not import flax"),
    ("sqn_jax/leftover.py", "", "the room leftover has no place"),
    ("sqn_jax/figures.py", "from sqn_jax.runlog import x", "import each other"),
    ("sqn_jax/train.py", "import matplotlib.pyplot as plt", "matplotlib belongs in figures"),
    ("experiments/benchmark.py", "import imageio", "imageio belongs in figures"),
    ("sqn_jax/rollout.py", "import jax\nf = jax.jit(abs)", "jit belongs in"),
    ("sqn_jax/agent/loss.py", "import jax\n@jax.jit\ndef f(): ...", "jit belongs in"),
    ("sqn_jax/agent/loss.py", "from jax import jit as fast", "jit belongs in"),
    ("experiments/benchmark.py", "import jax\nf = jax.jit(abs)", "jit belongs in"),
    ("sqn_jax/env/geometry.py", "print(1)", "env does no I/O and may not call print"),
    ("sqn_jax/env/geometry.py", "import jax\njax.debug.print('x')", "may not call print"),
    ("sqn_jax/agent/loss.py", "open('x')", "agent does no I/O and may not call open"),
    ("sqn_jax/rollout.py", "import time", "rollout does no I/O and may not import time"),
    ("sqn_jax/rollout.py", "from time import monotonic", "rollout does no I/O and may not import"),
    ("sqn_jax/train.py", "import pickle", "pickle is not to be used"),
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
def test_the_source_keeps_to_the_architecture(checker):
    assert len(sources(ROOT)) > 10, "the source was not found"
    assert list(checker(ROOT)) == []


def test_a_clean_tree_has_no_fault(tmp_path):
    write_tree(tmp_path, CLEAN_TREE)
    assert faults(tmp_path) == []


@pytest.mark.parametrize(("path", "text", "expected"), FAULTS)
def test_a_planted_fault_is_found_where_it_stands(tmp_path, path, text, expected):
    write_tree(tmp_path, CLEAN_TREE | {"sqn_jax/runlog.py": "from sqn_jax.figures import draw\n"})
    write_tree(tmp_path, {path: text})
    found = faults(tmp_path)
    assert len(found) == 1, found
    assert expected in found[0]
    assert path in found[0] or "sqn_jax.figures, sqn_jax.runlog" in found[0]


def test_files_and_functions_at_the_limit_are_allowed(tmp_path):
    function = LONG_FUNCTION.removesuffix("    x = 1\n")
    file = LONG_FILE.removesuffix("x = 1\n")
    write_tree(tmp_path, CLEAN_TREE | {"sqn_jax/cli.py": file, "experiments/report.py": function})
    assert faults(tmp_path) == []
