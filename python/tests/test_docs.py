"""Every example in a docstring and every snippet of the pages is run; the API page says what the docstrings say."""

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

NEEDS = {"parallel_env": "pettingzoo", "team_env": "gymnasium", "VectorEnv": "gymnasium", "Run.to_pandas": "pandas"}


def documented():
    """Everything that is public, with its docstring."""
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
def test_examples_do_what_they_say(name, thing):
    text = inspect.getdoc(thing)
    assert text, f"{name} has no docstring"
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"{NEEDS[name]} is not installed")
    os.symlink(ROOT / "configs", "configs")
    known = {"flotilla": flotilla, "np": np, "os": os, **{name: getattr(flotilla, name) for name in flotilla.__all__}}
    test = doctest.DocTestParser().get_doctest(text, known, name, None, 0)
    said = []
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    doctest.DocTestRunner(optionflags=flags).run(test, out=said.append)
    assert not said, "".join(said)


SNIPPET = re.compile(
    r"(?P<why><!-- not run: .*? -->\n\n?)?```python\n(?P<code>.*?)```(?:\n+<!-- output -->\n+```text\n(?P<output>.*?)```)?", re.S
)


def snippets():
    """Every Python block of every page, with the output that the page shows."""
    for page in sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "python/README.md", *(ROOT / "docs").rglob("*.md")]):
        for number, found in enumerate(SNIPPET.finditer(page.read_text())):
            if not found["why"] and ">>>" not in found["code"]:
                yield pytest.param(found["code"], found["output"], id=f"{page.relative_to(ROOT)} {number}")


@pytest.mark.parametrize("code, output", list(snippets()))
def test_snippets_run(code, output, capsys):
    os.symlink(ROOT / "configs", "configs")
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})
    if output is not None:
        assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == output.rstrip().splitlines()


def test_the_api_page_is_current():
    made = subprocess.run([sys.executable, ROOT / "python/api.py"], capture_output=True, text=True, check=True).stdout
    assert made == (ROOT / "docs/reference/python.md").read_text(), "make it anew: python python/api.py > docs/reference/python.md"
