"""Run the notebooks in full and write each with its outputs beside it: NN_name.py to NN_name.ipynb.

    .venv/bin/python notebooks/execute.py [--words-only] [NAME ...]

A notebook is its .py file; the .ipynb holds the same cells with what they printed and drew. What
would differ from run to run without saying anything (times, versions, random names of cells) is
left out of it. After a change of words alone, --words-only takes the outputs from the .ipynb.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SECONDS = 900
"""A cell that takes longer is given up."""


def main() -> None:
    """Parse the names and run one notebook after the other."""
    names = sorted(path.stem for path in HERE.glob("[0-9][0-9]_*.py"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=names, metavar="NAME", help=", ".join(names))
    parser.add_argument("--words-only", action="store_true", help="run nothing")
    options = parser.parse_args()
    for name in options.names:
        stem = Path(name).stem
        if stem not in names:
            sys.exit(f"no notebook {name!r}, expected one of {', '.join(names)}")
        begun = time.monotonic()
        write(HERE / f"{stem}.py", words_only=options.words_only)
        size = (HERE / f"{stem}.ipynb").stat().st_size / 1e3
        print(f"{stem}.ipynb: {time.monotonic() - begun:.0f} s, {size:.0f} kB", flush=True)


def write(source: Path, *, words_only: bool) -> None:
    """Write the .ipynb of a script, all or nothing.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; nothing is written.
    """
    import jupytext
    import nbformat

    notebook = jupytext.read(source)
    for cell in notebook.cells:
        # The script's format wants empty lines around functions, a cell's does not.
        cell.source = cell.source.strip("\n")
    if words_only:
        keep_outputs(notebook, nbformat.read(source.with_suffix(".ipynb"), as_version=4))
    else:
        execute(notebook)
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number:02d}"
        cell.metadata.clear()
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata = nbformat.from_dict(
        {
            "jupytext": {"formats": "ipynb,py:percent"},
            "kernelspec": kernel,
            "language_info": {"name": "python"},
        }
    )
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    nbformat.validate(notebook)
    partial = source.with_name(f".{source.stem}.{os.getpid()}.partial")
    try:
        partial.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")
        partial.replace(source.with_suffix(".ipynb"))
    finally:
        partial.unlink(missing_ok=True)


def execute(notebook: Any) -> None:
    """Run the cells of a notebook in this Python and put their outputs into it."""
    from jupyter_client.manager import KernelManager
    from nbclient import NotebookClient

    with tempfile.TemporaryDirectory() as folder:
        # Pipes instead of ports, and the Python of this environment, whatever the user's kernels.
        manager = KernelManager(transport="ipc", ip=str(Path(folder) / "kernel"))
        assert manager.kernel_spec is not None
        manager.kernel_spec.argv[0] = sys.executable
        client = NotebookClient(notebook, km=manager, timeout=SECONDS, record_timing=False)
        try:
            client.execute(cwd=str(HERE))
        finally:
            if manager.has_kernel:
                manager.shutdown_kernel(now=True)


def keep_outputs(notebook: Any, before: Any) -> None:
    """Put the outputs of an earlier run into a notebook whose code is the same."""
    code, earlier = (
        [cell for cell in each.cells if cell.cell_type == "code"] for each in (notebook, before)
    )
    if [cell.source for cell in code] != [cell.source for cell in earlier]:
        sys.exit("code has changed since the last run, expected a change of words alone")
    for cell, past in zip(code, earlier, strict=True):
        cell.outputs, cell.execution_count = past.outputs, past.execution_count


if __name__ == "__main__":
    main()
