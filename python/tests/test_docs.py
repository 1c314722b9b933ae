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

NEEDS = {"parallel_env": "pettingzoo", "VectorEnv": "gymnasium", "Run.to_pandas": "pandas"}


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


def snippets():
    pages = ("README.md", "python/README.md", "docs/reference/python.md", "docs/tutorial/python.md", "docs/how-to/another-optimiser.md")
    for page in map(ROOT.joinpath, pages):
        for number, (why, code) in enumerate(re.findall(r"(<!-- not run: .*? -->\n\n?)?```python\n(.*?)```", page.read_text(), re.S)):
            if not why and ">>>" not in code:
                yield pytest.param(code, id=f"{page.relative_to(ROOT)} {number}")


@pytest.mark.parametrize("code", list(snippets()))
def test_snippets_run(code):
    os.symlink(ROOT / "configs", "configs")
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})


def test_the_api_page_is_current():
    made = subprocess.run([sys.executable, ROOT / "python/api.py"], capture_output=True, text=True, check=True).stdout
    assert made == (ROOT / "docs/reference/python.md").read_text(), "make it anew: python python/api.py > docs/reference/python.md"
