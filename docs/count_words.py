"""Prints, for each page, the words of prose, the words in tables, and the mean and longest sentence.

    python3 docs/count_words.py [PAGE ...]

Code blocks, comments, link targets and headings do not count as prose. The total is without generated pages. If pages
are named, sentences of more than 30 words are printed, too.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERATED = {"docs/reference/config.md", "docs/reference/python.md",
             "docs/results/claims-measured.md", "docs/results/questions-tables.md", "benches/static-figures.md"}
LOGS = ["benches/README.md", "benches/peers/README.md", "benches/static-figures.md"]


def parts(text):
    """Splits a page into paragraphs of prose and rows of tables."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"^\s*```.*?^\s*```", "\n", text, flags=re.S | re.M)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    prose, tables = [""], []
    for line in text.splitlines():
        if line.lstrip().startswith("|"):
            tables.append(line)
        elif not line.strip() or line.startswith(("#", "    ")) or re.match(r"\s*([-*]|\d+\.) ", line):
            prose.append("" if line.startswith(("#", "    ")) else re.sub(r"^\s*([-*]|\d+\.) ", "", line))
        else:
            prose[-1] += " " + line
    return [paragraph for paragraph in prose if paragraph.strip()], tables


def words(text):
    """Returns the words of a text; punctuation alone is not a word."""
    return [word for word in text.split() if re.search(r"\w", word)]


def sentences(paragraphs):
    """Yields the sentences of paragraphs."""
    for paragraph in paragraphs:
        text = re.sub(r"`[^`]*`", lambda code: code.group(0).replace(".", "·").replace(" ", "·"), paragraph)
        text = re.sub(r"\b(e\.g|i\.e|Fig|vs|al)\.", r"\1", text)
        for sentence in re.split(r"(?<=[.?!])[\"”)*_]*\s+", text):
            if words(sentence):
                yield sentence


def main():
    named = [Path(name).resolve() for name in sys.argv[1:]]
    pages = named or [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")),
                      *(ROOT / log for log in LOGS)]
    total = 0
    print(f"{'prose':>6} {'table':>6} {'mean':>5} {'max':>4}  page")
    for page in filter(Path.exists, pages):
        prose, tables = parts(page.read_text())
        lengths = [len(words(sentence)) for sentence in sentences(prose)]
        counted, in_tables = sum(len(words(text)) for text in prose), sum(len(words(row)) for row in tables)
        name = str(page.relative_to(ROOT)) if page.is_relative_to(ROOT) else str(page)
        total += 0 if name in GENERATED else counted + in_tables
        mean = sum(lengths) / max(len(lengths), 1)
        note = "  (generated)" if name in GENERATED else ""
        print(f"{counted:6} {in_tables:6} {mean:5.1f} {max(lengths, default=0):4}  {name}{note}")
        # Show which sentences are too long.
        if named:
            for sentence in sentences(prose):
                if len(words(sentence)) > 30:
                    print(f"       {len(words(sentence))}: {sentence.strip()}")
    print(f"{total:6} words in total, prose and tables, without generated pages")


main()
