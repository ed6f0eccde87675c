"""Where the time of a command goes that is not learning: imports, maps, compiling, figures.

    bench_start.py [--repeats N] [--out FILE] [COMMAND ...]     default: train --preset smoke

Each repeat runs `sqn COMMAND` in a new process, once with an empty folder for compiled programs
(cold), and once with one that has them all (warm). The parts are timed from outside: JAX reports
what it traces, lowers and compiles, and a few functions of the package are wrapped by a clock.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
MEASURED = "SQN_BENCH_START_OUT"
"""Environment variable by which a process knows that it is the one measured: where it writes."""

CLOCKED = {
    "sqn_jax.runs.train": {
        "load_map": "maps",
        "make_env": "tables",
        "run": "run the training",
        "_Training._save": "checkpoints",
    },
    "sqn_jax.evaluation.settings": {"make_env": "tables"},
    "sqn_jax.evaluation.compare": {"_shortest_paths": "shortest paths"},
    "sqn_jax.evaluation.episodes": {"run_seeds": "run the evaluation"},
    "sqn_jax.runs.final_evaluation": {"draw_figures": "figures"},
    "sqn_jax.storage.compile_cache": {
        "_tidy": "check the cache",
        "_open_folder": "check the cache",
    },
}
"""Functions that are clocked, by the name of their part; what JAX does within is its own."""

EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile or read",
}


class Spans:
    """Stretches of time by name, of each thread; one within another counts as its own only."""

    def __init__(self) -> None:
        self._spans: list[tuple[int, float, float, str, str]] = []

    def add(self, start: float, end: float, kind: str, detail: str = "") -> None:
        self._spans.append((threading.get_ident(), start, end, kind, detail))

    def clock(self, function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        """The function under a clock; of a generator each piece of its work."""

        @functools.wraps(function)
        def clocked(*args: Any, **kwargs: Any) -> Any:
            started = time.monotonic()
            result = function(*args, **kwargs)
            self.add(started, time.monotonic(), kind)
            return pieces(result) if hasattr(result, "send") else result

        def pieces(generator: Any) -> Any:
            while True:
                started = time.monotonic()
                piece = next(generator, clocked)
                self.add(started, time.monotonic(), kind)
                if piece is clocked:
                    return
                yield piece

        return clocked

    def own(self) -> list[tuple[bool, str, str, float]]:
        """Whether in this thread, kind, detail and seconds, less those of the spans within."""
        owned = []
        for thread in {span[0] for span in self._spans}:
            spans = sorted((s for s in self._spans if s[0] == thread), key=lambda s: (s[1], -s[2]))
            around: list[int] = []
            seconds = [end - start for _, start, end, _, _ in spans]
            for index, (_, start, end, _, _) in enumerate(spans):
                while around and spans[around[-1]][2] <= start:
                    around.pop()
                if around:
                    seconds[around[-1]] -= min(end, spans[around[-1]][2]) - start
                around.append(index)
            is_own = thread == threading.get_ident()
            owned += [(is_own, span[3], span[4], s) for span, s in zip(spans, seconds, strict=True)]
        return owned


def measured(command: list[str], out: Path) -> int:
    """Run `sqn COMMAND` in this process and write where its time went."""
    started = time.monotonic()
    spans = Spans()
    from sqn_jax import cli

    if command:
        import jax

        importlib.import_module("sqn_jax.runs.train")

        def note(event: str, duration_secs: float, **about: str | int) -> None:
            if event in EVENTS:
                now = time.monotonic()
                spans.add(now - duration_secs, now, EVENTS[event], str(about.get("fun_name", "")))

        jax.monitoring.register_event_duration_secs_listener(note)
        for module, functions in CLOCKED.items():
            for name, kind in functions.items():
                owner: Any = importlib.import_module(module)
                *holders, leaf = name.split(".")
                for holder in holders:
                    owner = getattr(owner, holder)
                setattr(owner, leaf, spans.clock(getattr(owner, leaf), kind))
        loop, train = (
            importlib.import_module(f"sqn_jax.{x}") for x in ("training.loop", "runs.train")
        )
        train.run = loop.run  # type: ignore[attr-defined]
    spans.add(started, time.monotonic(), "import")
    sys.argv = ["sqn", *command]
    code: Any = None
    try:
        with mock.patch.object(os, "_exit", sys.exit):  # How a command ends; we have more to do.
            cli.run()
    except SystemExit as stop:
        code = stop.code
    whole = time.monotonic() - started
    seconds: dict[str, float] = defaultdict(float)
    programs: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for is_own, kind, detail, own in spans.own():
        seconds[kind if is_own else f"{kind} (in a thread)"] += own
        if detail:
            programs[detail][kind] += own
            programs[detail]["times " + kind] += 1
    known = sum(own for is_own, _, _, own in spans.own() if is_own)
    seconds["other"] = whole - known
    out.write_text(json.dumps({"seconds": seconds, "programs": programs}), encoding="utf-8")
    return int(code or 0)


def run_once(command: list[str], cache: Path) -> dict[str, Any]:
    """`sqn COMMAND` in a process of its own; its seconds from start to end, and where they went."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "measured.json"
        environment = {**os.environ, "SQN_JAX_CACHE": str(cache), MEASURED: str(out)}
        environment["PYTHONPATH"] = str(ROOT)
        extra = ["--run-dir", f"{folder}/run"] if command[:1] == ["train"] else []
        started = time.monotonic()
        subprocess.run(
            [sys.executable, __file__, *command, *extra],
            env=environment,
            stdout=subprocess.DEVNULL,
            check=True,
        )
        whole = time.monotonic() - started
        measured: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    seconds = measured["seconds"]
    seconds["start and end of Python"] = whole - sum(
        s for kind, s in seconds.items() if "thread" not in kind
    )
    return {"whole": whole, **measured}


def summary(repeats: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians of the repeats, and the programs of the last one, the longest first."""
    kinds = {kind for repeat in repeats for kind in repeat["seconds"]}
    medians = {
        kind: statistics.median(repeat["seconds"].get(kind, 0.0) for repeat in repeats)
        for kind in kinds
    }
    programs = repeats[-1]["programs"]
    ordered = sorted(programs, key=lambda name: -sum(_durations(programs[name]).values()))
    return {
        "whole": round(statistics.median(repeat["whole"] for repeat in repeats), 2),
        "all": [round(repeat["whole"], 2) for repeat in repeats],
        "seconds": {k: round(v, 2) for k, v in sorted(medians.items(), key=lambda x: -x[1])},
        "programs": {name: {k: round(v, 3) for k, v in programs[name].items()} for name in ordered},
    }


def _durations(program: dict[str, float]) -> dict[str, float]:
    return {kind: value for kind, value in program.items() if not kind.startswith("times ")}


def show(name: str, summed: dict[str, Any], num_programs: int) -> None:
    """Print a breakdown."""
    print(f"{name}: {summed['whole']:.2f} s, median of {summed['all']}")
    for kind, seconds in summed["seconds"].items():
        if seconds >= 0.01:
            print(f"  {seconds:7.2f}  {kind}")
    compiled = [
        p["times compile or read"]
        for p in summed["programs"].values()
        if "times compile or read" in p
    ]
    print(f"  {sum(compiled):.0f} programs; those that took longest:")
    for program, parts_of in list(summed["programs"].items())[:num_programs]:
        parts = ", ".join(
            f"{kind} {seconds:.2f} ({parts_of['times ' + kind]:.0f}x)"
            for kind, seconds in _durations(parts_of).items()
        )
        print(f"    {program}: {parts}")


def main() -> None:
    """Measure a command, cold and warm."""
    if MEASURED in os.environ:
        os._exit(measured(sys.argv[1:], Path(os.environ[MEASURED])))
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", choices=("cold", "warm"), help="not both")
    parser.add_argument("--programs", type=int, default=12, help="how many are listed")
    parser.add_argument("--out", type=Path, help="a file for the numbers")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="of sqn, with its options")
    options = parser.parse_args()
    command = options.command or ["train", "--preset", "smoke"]
    repeats: dict[str, list[dict[str, Any]]] = {"cold": [], "warm": []}
    with tempfile.TemporaryDirectory() as folder:
        caches = Path(folder)
        caches.chmod(0o700)
        if options.only == "warm":
            run_once(command, caches / "0")
        for turn in range(options.repeats):
            if options.only != "warm":
                repeats["cold"].append(run_once(command, caches / str(turn)))
            if options.only != "cold":
                repeats["warm"].append(run_once(command, caches / "0"))
    results = {name: summary(measured) for name, measured in repeats.items() if measured}
    for name, summed in results.items():
        show(name, summed, options.programs)
    if options.out is not None:
        contents = {"command": command, **results}
        options.out.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
