"""Runs the notebooks and the examples. Those that need large packages run only in the long form of the tests.

`test_trainers.py` runs the other examples.
"""

import os
import re
import subprocess
import sys

import pytest
from conftest import ROOT

long = pytest.mark.skipif(not os.environ.get("FLOTILLA_LONG"), reason="by request: FLOTILLA_LONG=1")
NOTEBOOKS = sorted((ROOT / "python/notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path):
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    pytest.importorskip("pandas", reason="pandas is not installed")
    book = nbformat.read(path, as_version=4)
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.outputs for cell in cells if "print" in cell.source), "commit the notebook with its outputs"
    nbclient.NotebookClient(book, timeout=300).execute()


def test_there_are_notebooks():
    assert len(NOTEBOOKS) == 4


@pytest.mark.parametrize(
    "name, needs",
    [
        ("leaders_by_es", "numpy"),
        # These need packages of hundreds of megabytes.
        pytest.param("leaders_by_evosax", "evosax", marks=long),
        pytest.param("ppo", "torch", marks=long),
    ],
)
def test_examples_run(name, needs):
    pytest.importorskip(needs, reason=f"{needs} is not installed")
    command = [sys.executable, ROOT / f"python/examples/{name}.py", "2"]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert re.search(r"^(generation|iteration)   1: G", output, re.M), output
