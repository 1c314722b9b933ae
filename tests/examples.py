"""Compiles the workspace with each worked example of CONTRIBUTING.md, applied to a copy of the last commit.

    python3 tests/examples.py BUILD_DIRECTORY

A hunk is some lines of one place in a file, below its name.
"""

import pathlib
import re
import shutil
import subprocess
import sys
import tempfile


def apply(folder, diff):
    for hunk in diff.split("--- ")[1:]:
        name, changes = hunk.split("\n", 1)
        lines = changes.splitlines()
        before, after = (
            "".join(line[1:] + "\n" for line in lines if not line.startswith(sign)) for sign in "+-"
        )
        path = folder / name
        text = path.read_text()
        assert text.count(before) == 1, f"{name} has these lines {text.count(before)} times:\n{before}"
        path.write_text(text.replace(before, after))


def main():
    root = pathlib.Path(__file__).resolve().parent.parent
    diffs = re.findall(r"```diff\n(.*?)```", (root / "CONTRIBUTING.md").read_text(), re.S)
    assert len(diffs) == 3, f"CONTRIBUTING.md has {len(diffs)} worked examples"
    for diff in diffs:
        with tempfile.TemporaryDirectory() as folder:
            copy = pathlib.Path(folder) / "copy"
            subprocess.run(["git", "clone", "--quiet", root, copy], check=True)
            shutil.copy(root / "CONTRIBUTING.md", copy)
            apply(copy, diff)
            check = ["cargo", "check", "--quiet", "--locked", "--workspace", "--tests", "--target-dir", sys.argv[1]]
            subprocess.run(check, cwd=copy, check=True)
    print(f"{len(diffs)} worked examples compile")


if __name__ == "__main__":
    main()
