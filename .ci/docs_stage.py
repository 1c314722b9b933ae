"""Copies docs/ to target/docs for the site, and rewrites links.

    python3 .ci/docs_stage.py [FLOTILLA]

- A file outside docs/ that a page links to is copied to repository/PATH, and the links are adapted.
- `<!-- site: TEXT -->` on a page becomes TEXT. It is for links that exist only on the site, such as the browser page.
- On the pages of the Python reference, mkdocstrings replaces the text after the introduction.
- FLOTILLA is the program. If it is given, the page of commands gets the full help of each command.
"""

import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
STAGE = ROOT / "target/docs"
PYTHON = ROOT / "target/docs-python"
SITE_ONLY = re.compile(r"<!-- site: (.*?) -->", re.S)
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")


def in_site(path):
    """Returns the path in the site of a file of the repository."""
    # MkDocs ignores names that begin with a dot.
    return path.removeprefix("docs/") if path.startswith("docs/") else "repository/" + path.lstrip(".")


def target(page, link):
    """Returns the path of the file in the repository that a link leads to, or None for any other link."""
    if re.match(r"[a-z]+:", link):
        return None
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    return path if (ROOT / path).is_file() else None


def rewritten(text, page):
    """Returns a page's text with its links adapted to the site."""

    def link(match):
        path = target(page, match[2])
        if path is None:
            return match[0]
        there = posixpath.relpath(in_site(path), posixpath.dirname(in_site(page)) or ".")
        return match[1] + there + (match[3] or "") + match[4]

    return LINK.sub(link, text)


def command_help(program):
    """Returns a section with the full help of each command."""

    def printed(*arguments):
        return subprocess.run([program, *arguments], check=True, capture_output=True, text=True).stdout

    names = [name for name in re.findall(r"^ +([a-z-]+) {2,}\S", printed("help"), re.M) if name != "help"]
    texts = [f"\n### flotilla {name}\n\n```text\n{printed('help', name)}```\n" for name in names]
    return "\n## Every flag\n" + "".join(texts)


def stage_python():
    """Copies the Python package and adapts its docstrings to mkdocstrings: sections "Examples", and no Sphinx roles."""
    shutil.rmtree(PYTHON, ignore_errors=True)
    for path in [*(ROOT / "python/flotilla").glob("*.py"), *(ROOT / "python/flotilla").glob("*.pyi")]:
        text = re.sub(r"^( *)Example:$", r"\1Examples:", path.read_text(), flags=re.M)
        there = PYTHON / "flotilla" / path.name
        there.parent.mkdir(parents=True, exist_ok=True)
        there.write_text(re.sub(r":(?:meth|class|func|attr|mod):`~?", "`", text))


def main():
    stage_python()
    shutil.rmtree(STAGE, ignore_errors=True)
    shutil.copytree(ROOT / "docs", STAGE, ignore=shutil.ignore_patterns("__pycache__"))
    waiting = [path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md")]
    seen = set(waiting)
    while waiting:
        page = waiting.pop()
        text = (ROOT / page).read_text()
        for match in LINK.finditer(text):
            path = target(page, match[2])
            if path is None or path.startswith("docs/") or path in seen:
                continue
            seen.add(path)
            if path.endswith(".md"):
                waiting.append(path)
            else:
                there = STAGE / in_site(path)
                there.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / path, there)
        if page.startswith("docs/reference/python/"):
            # mkdocstrings documents each name, member by member.
            names = re.findall(r"^## `(\w+)`$", text, re.M)
            text = text.split("\n## ")[0] + "".join(f"\n::: flotilla.{name}\n" for name in names)
        if page == "docs/reference/commands.md" and len(sys.argv) > 1:
            text += command_help(sys.argv[1])
        there = STAGE / in_site(page)
        there.parent.mkdir(parents=True, exist_ok=True)
        there.write_text(SITE_ONLY.sub(r"\1", rewritten(text, page)))
    for built, place in (("target/doc", "rust"), ("web/dist", "page")):
        if not (ROOT / built).is_dir():
            sys.exit(f"{built} is missing; .ci/docs builds it")
        # rustdoc's pages of source code would take most of the site's space.
        shutil.copytree(ROOT / built, STAGE / place, ignore=shutil.ignore_patterns("src", ".lock"))


main()
