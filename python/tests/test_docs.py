"""Runs the examples in docstrings and the Python snippets of the documentation. Checks that the API page is current."""

import doctest
import inspect
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT

import flotilla

NEEDS = {"parallel_env": "pettingzoo", "team_env": "gymnasium", "VectorEnv": "gymnasium", "compare": "pandas", "Run.to_pandas": "pandas"}


def documented():
    """Yields the name and the object of everything public."""
    for name in flotilla.__all__:
        thing = getattr(flotilla, name)
        yield name, thing
        if inspect.isclass(thing) and thing.__module__.startswith("flotilla"):
            for member, value in sorted(vars(thing).items()):
                function = getattr(value, "__func__", value)
                if not member.startswith("_") and (inspect.isfunction(function) or isinstance(value, property)):
                    yield f"{name}.{member}", function
        if inspect.ismodule(thing):
            for member, value in sorted(vars(thing).items()):
                if inspect.isfunction(value) and value.__module__ == thing.__name__:
                    yield f"{name}.{member}", value


@pytest.mark.parametrize("name, thing", list(documented()), ids=lambda value: value if isinstance(value, str) else "")
def test_docstring_examples_run(name, thing):
    text = inspect.getdoc(thing)
    assert text, f"{name} has no docstring"
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"{NEEDS[name]} is not installed")
    os.symlink(ROOT / "configs", "configs")
    scope = {"flotilla": flotilla, "np": np, "os": os, **{name: getattr(flotilla, name) for name in flotilla.__all__}}
    test = doctest.DocTestParser().get_doctest(text, scope, name, None, 0)
    failures = []
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    doctest.DocTestRunner(optionflags=flags).run(test, out=failures.append)
    assert not failures, "".join(failures)


SNIPPET = re.compile(
    r"(?P<skipped><!-- not run: .*? -->\n\n?)?```python\n(?P<code>.*?)```"
    r"(?:\n+<!-- output -->\n+```text\n(?P<output>.*?)```)?",
    re.S,
)


def snippets():
    """Yields the Python blocks of all pages, with the output that the page shows."""
    readmes = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "python/README.md"]
    for page in sorted([*readmes, *(ROOT / "docs").rglob("*.md")]):
        for number, snippet in enumerate(SNIPPET.finditer(page.read_text())):
            if not snippet["skipped"] and ">>>" not in snippet["code"]:
                yield pytest.param(snippet["code"], snippet["output"], id=f"{page.relative_to(ROOT)} {number}")


@pytest.mark.parametrize("code, output", list(snippets()))
def test_snippets_run(code, output, capsys):
    os.symlink(ROOT / "configs", "configs")
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})
    if output is not None:
        assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == output.rstrip().splitlines()


def test_the_api_pages_are_current(tmp_path):
    subprocess.run([sys.executable, ROOT / "python/api.py", tmp_path], check=True)
    made, current = (
        {path.relative_to(folder): path.read_text() for path in [folder / "python.md", *(folder / "python").iterdir()]}
        for folder in (tmp_path, ROOT / "docs/reference")
    )
    assert made == current, "run: python python/api.py docs/reference"
