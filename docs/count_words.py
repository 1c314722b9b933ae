"""Prints, for each page, the words of prose, the words in tables, and the mean and longest sentence.

    python3 docs/count_words.py [PAGE ...]

Code blocks, comments, link targets and headings do not count as prose. The totals are without generated pages and pages
of tables. A page of tables is named *-tables.md. Fails if one has more than 300 words of prose, or another page of
results more than 700 words. If pages are named, sentences of more than 30 words are printed, too.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
GENERATED = {"docs/reference/config.md", "docs/results/claims-measured.md", "benches/static-figures.md",
             *(f"docs/reference/python/{page.name}" for page in (ROOT / "docs/reference/python").iterdir())}
# The most words of a page of results, and of prose on a page of tables.
MOST_RESULTS, MOST_AROUND_TABLES = 700, 300
LOGS = ["benches/README.md", "benches/log-tables.md", "benches/peers/README.md", "benches/static-figures.md"]


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
    total = [0, 0]
    failed = []
    print(f"{'prose':>6} {'table':>6} {'mean':>5} {'max':>4}  page")
    for page in filter(Path.exists, pages):
        prose, tables = parts(page.read_text())
        lengths = [len(words(sentence)) for sentence in sentences(prose)]
        counted, in_tables = sum(len(words(text)) for text in prose), sum(len(words(row)) for row in tables)
        name = str(page.relative_to(ROOT)) if page.is_relative_to(ROOT) else str(page)
        is_tables, is_results = name.endswith("-tables.md"), name.startswith("docs/results/")
        if name not in GENERATED and not is_tables:
            total = [total[0] + counted, total[1] + in_tables]
        if name not in GENERATED and (is_tables and counted > MOST_AROUND_TABLES
                                      or is_results and not is_tables and counted + in_tables > MOST_RESULTS):
            failed.append(name)
        mean = sum(lengths) / max(len(lengths), 1)
        note = "  (generated)" if name in GENERATED else "  (tables)" if is_tables else ""
        print(f"{counted:6} {in_tables:6} {mean:5.1f} {max(lengths, default=0):4}  {name}{note}")
        # Show which sentences are too long.
        if named:
            for sentence in sentences(prose):
                if len(words(sentence)) > 30:
                    print(f"       {len(words(sentence))}: {sentence.strip()}")
    print(f"{total[0]:6} {total[1]:6} in total, without generated pages and pages of tables")
    if failed:
        sys.exit(f"too long: {', '.join(failed)}")


main()
