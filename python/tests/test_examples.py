"""The notebooks and the examples run; where what they need is small."""

import subprocess
import sys

import pytest
from conftest import ROOT

NOTEBOOKS = sorted((ROOT / "python/notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path):
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    pytest.importorskip("pandas", reason="pandas is not installed")
    book = nbformat.read(path, as_version=4)
    kept = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.outputs for cell in kept if "print" in cell.source), "the outputs are to be read on the web"
    nbclient.NotebookClient(book, timeout=300).execute()


def test_there_are_notebooks():
    assert len(NOTEBOOKS) == 4


@pytest.mark.parametrize("name, needs", [("leaders_by_es", None), ("cma_shared", "cma")])
def test_examples_run(name, needs):
    if needs:
        pytest.importorskip(needs, reason=f"{needs} is not installed")
    words = [sys.executable, ROOT / f"python/examples/{name}.py", "2"]
    assert "generation   1" in subprocess.run(words, capture_output=True, text=True, check=True).stdout
