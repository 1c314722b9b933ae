"""Brings files that pages link to outside docs/ into the site, and adds each command's help to the page of commands."""

import os
import posixpath
import re
import subprocess
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")


def in_site(path):
    """Returns where a file of the repository is in the site."""
    return path.removeprefix("docs/") if path.startswith("docs/") else "repository/" + path


def target(page, link):
    """Returns the repository's file that a link of a page leads to, if it is one."""
    if re.match(r"[a-z]+:", link):
        return None
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    return path if (ROOT / path).is_file() else None


def rewritten(text, page):
    def link(match):
        path = target(page, match[2])
        if path is None:
            return match[0]
        there = posixpath.relpath(in_site(path), posixpath.dirname(in_site(page)) or ".")
        return match[1] + there + (match[3] or "") + match[4]

    return LINK.sub(link, text)


def on_files(files, config):
    waiting = ["docs/" + file.src_uri for file in files if file.is_documentation_page()]
    brought = set()
    while waiting:
        page = waiting.pop()
        for match in LINK.finditer((ROOT / page).read_text()):
            path = target(page, match[2])
            if path is None or path.startswith("docs/") or path in brought:
                continue
            brought.add(path)
            if path.endswith(".md"):
                waiting.append(path)
                content = rewritten((ROOT / path).read_text(), path)
            else:
                content = (ROOT / path).read_bytes()
            files.append(File.generated(config, in_site(path), content=content))
    return files


def on_page_markdown(markdown, page, **_):
    source = page.file.src_uri
    if source.startswith("repository/"):
        return markdown
    if source == "reference/commands.md":
        markdown += command_help()
    return rewritten(markdown, "docs/" + source)


def command_help():
    """Returns the full help of every command, if FLOTILLA names the program."""
    program = os.environ.get("FLOTILLA")
    if not program:
        return ""

    def printed(*arguments):
        return subprocess.run([program, *arguments], check=True, capture_output=True, text=True).stdout

    names = re.findall(r"^  ([a-z-]+) {2,}", printed("help"), re.M)
    texts = [f"\n### flotilla {name}\n\n```text\n{printed('help', name)}```\n" for name in names if name != "help"]
    return "\n## Every flag\n" + "".join(texts)
