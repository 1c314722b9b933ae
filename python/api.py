"""Writes python.md and python/*.md into a directory, made from the package's docstrings and signatures.

    python python/api.py docs/reference
"""

from __future__ import annotations

import inspect
import re
import sys
import textwrap
from pathlib import Path

# Import the installed package. The sources next to this file have no native module.
sys.path = sys.path[1:]
import flotilla

OPENING = """\
# Python reference

For Python users: every function and class of `import flotilla`.

[The same in Python](../tutorial/python.md) is a gentler start. Arrays are NumPy's; shapes are written \
`[teams, leaders, inputs]`. Every
example is run by the package's tests, with `np` for NumPy.

The pages are made from the docstrings by `python python/api.py docs/reference`.
"""
ORDER = [
    ("Configs", ["Config", "Key", "ConfigError", "Problem"]),
    ("Training", ["train", "Run", "Generation", "Error", "loggers"]),
    ("Your own fitness", ["Coevolution", "Proposal", "Played"]),
    ("Looking", ["Replay", "Episode", "Figure", "plot", "compare", "Comparison"]),
    ("Evaluating", ["rollout", "Rollout", "Trace", "score", "Scores", "replay"]),
    ("Networks", ["forward", "collect", "Collected", "to_onnx"]),
    ("Environments", ["VectorEnv", "team_env", "parallel_env"]),
    ("Many runs", ["sweep", "Sweep", "Point", "paper"]),
    ("The machine", ["devices", "verify"]),
]


def markdown(text: str) -> str:
    """Returns a docstring as Markdown: sections become paragraphs and lists, and examples become code blocks."""
    text = re.sub(r":(?:func|meth|class):`([^`]*)`", r"`\1`", text).replace("``", "`")
    lines, made, section = text.splitlines(), [], None
    index = 0
    while index < len(lines):
        line = lines[index]
        if re.fullmatch(r"(Args|Returns|Raises|Attributes|Example):", line):
            section = line[:-1]
            block = []
            index += 1
            while index < len(lines) and (not lines[index] or lines[index].startswith(" ")):
                block.append(lines[index])
                index += 1
            body = textwrap.dedent("\n".join(block)).strip("\n")
            if section == "Example":
                made += ["```python", *body.splitlines(), "```", ""]
            else:
                made += [f"**{section}**", ""]
                entries = re.split(r"\n(?! )", body)
                bullet = section != "Returns"
                for entry in entries:
                    joined = " ".join(part.strip() for part in entry.splitlines() if part.strip())
                    if bullet:
                        joined = re.sub(r"^([\w*]+): ", r"`\1`: ", joined)
                        joined = "- " + joined
                    made.append(joined)
                made.append("")
            continue
        made.append(line)
        index += 1
    return re.sub(r"\n{3,}", "\n\n", "\n".join(made)).strip() + "\n"


def signature(name: str, thing: object) -> str:
    """Returns the name and the parameters of a function or class, without `self`, `cls` and quoted types."""
    try:
        text = str(inspect.signature(thing))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return name
    # Postponed annotations are strings, whose quotes are removed. Defaults keep theirs.
    text = re.sub(r"'([^']*)'", lambda part: part.group(0) if part.group(1) in ("", *DEFAULTS) else part.group(1), text)
    text = text.replace("(cls, ", "(").replace("(cls)", "()")
    return name + text.replace("(self, ", "(").replace("(self)", "()")


# Default arguments that are strings.
DEFAULTS = {
    "auto", "last", "Df", "G", "generally_forward", "leader-follower", "champion_g", "the config", "paper", "next_step", "champion"
}


def entry(name: str, thing: object, level: str) -> str:
    """Returns the heading, the signature and the text for one name."""
    title = f"{level} `{name}`\n\n"
    if isinstance(thing, property):
        return title + markdown(inspect.getdoc(thing) or "")
    if inspect.ismodule(thing):
        return title + markdown(inspect.getdoc(thing) or "")
    shown = ""
    if not (inspect.isclass(thing) and (issubclass(thing, tuple) or issubclass(thing, Exception) or name in HIDDEN)):
        shown = f"```text\n{textwrap.fill(signature(name, thing), 116, subsequent_indent='    ')}\n```\n\n"
    return title + shown + markdown(inspect.getdoc(thing) or "")


# Classes that users do not construct, because functions return them. Their signatures are not shown.
HIDDEN = {"Run", "Replay", "Figure", "Rollout", "Trace", "Sweep", "Generation", "Proposal", "Played", "Collected", "Comparison"}


def section(title: str, names: list[str]) -> str:
    """Returns the page with these names."""
    parts = [f"# {title}\n\nA part of the [Python reference](../python.md).\n"]
    for name in names:
        thing = getattr(flotilla, name)
        parts.append(entry(name, thing, "##"))
        if inspect.isclass(thing):
            members = [(member, value) for member, value in vars(thing).items() if not member.startswith("_")]
            for member, value in members:
                function = getattr(value, "__func__", value)
                if inspect.isfunction(function) or (isinstance(value, property) and inspect.getdoc(value)):
                    parts.append(entry(f"{name}.{member}", function, "###"))
        elif inspect.ismodule(thing):
            for member, value in vars(thing).items():
                if inspect.isfunction(value) and value.__module__ == thing.__name__:
                    parts.append(entry(f"{name}.{member}", value, "###"))
    return "\n".join(parts)


def main(folder: Path) -> None:
    missing = set(flotilla.__all__) - {name for _, names in ORDER for name in names}
    assert not missing, f"the pages leave out {missing}"
    (folder / "python").mkdir(exist_ok=True)
    contents = ""
    for title, names in ORDER:
        page = f"python/{title.lower().replace(' ', '-')}.md"
        contents += f"- [{title}]({page}): {', '.join(f'`{name}`' for name in names)}\n"
        (folder / page).write_text(section(title, names))
    (folder / "python.md").write_text(f"{OPENING}\n{contents}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
