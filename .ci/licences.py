"""Prints the licences of everything that a build of the program or the Python package contains.

    python3 .ci/licences.py TARGET [PACKAGE] > THIRD-PARTY-LICENSES.txt

PACKAGE is flotilla-teams or flotilla-python. The crates are those that `cargo metadata` reports as linked for TARGET,
without those that only build scripts and tests use. Fails if a crate declares no licence, or if its text is missing.
"""

import json
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
NAMES = ("LICENSE", "LICENCE", "COPYING", "NOTICE", "UNLICENSE", "COPYRIGHT")
# Parts that are not crates: a description, and the file with their licence.
OTHERS = [("DejaVu Sans, the font of pictures", ROOT / "app/src/report/font/LICENSE")]


def linked(metadata, package):
    """Returns the ids of the packages that `package` links, without its own."""
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    macros = {each["id"] for each in metadata["packages"]
              if any("proc-macro" in target["kind"] for target in each["targets"])}
    root = next(each["id"] for each in metadata["packages"] if each["name"] == package)
    found, open_ids = {root}, [root]
    while open_ids:
        for dependency in nodes[open_ids.pop()]["deps"]:
            is_linked = any(kind["kind"] is None for kind in dependency["dep_kinds"])
            if is_linked and dependency["pkg"] not in found | macros:
                found.add(dependency["pkg"])
                open_ids.append(dependency["pkg"])
    return found - {root}


def texts(folder):
    """Returns the texts of the licence files in a folder."""
    files = [file for file in sorted(folder.iterdir()) if file.is_file() and file.name.upper().startswith(NAMES)]
    inside = [file for part in sorted(folder.iterdir()) if part.is_dir() and part.name.upper().startswith(NAMES)
              for file in sorted(part.iterdir()) if file.is_file()]
    return [file.read_text("utf-8", "replace").replace("\r\n", "\n").strip() + "\n" for file in files + inside]


def standard(crate):
    """Returns the standard text, with the copyright holders, for a crate whose package has no licence file."""
    if "Apache-2.0" in crate["license"]:
        name = "LICENSE-APACHE"
    elif "MIT" in crate["license"]:
        name = "LICENSE-MIT"
    else:
        sys.exit(f"{crate['name']}: its licence is {crate['license']}, but its package does not contain the text")
    lines = [line for line in (ROOT / name).read_text().strip().splitlines() if not line.startswith("Copyright")]
    holders = ", ".join(crate["authors"]) or f"the authors of {crate['name']}"
    return [f"Copyright (c) {holders}\n{crate['repository'] or ''}\n\n" + "\n".join(lines) + "\n"]


def main(target, package="flotilla-teams"):
    command = ["cargo", "metadata", "--format-version", "1", "--locked", "--filter-platform", target]
    metadata = json.loads(subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout)
    ids = linked(metadata, package)
    crates = [each for each in metadata["packages"] if each["id"] in ids and each["source"]]
    # Tuples of name with version, licence expression, and texts.
    parts = []
    for crate in sorted(crates, key=lambda each: (each["name"], each["version"])):
        name, expression = f"{crate['name']} {crate['version']}", crate["license"]
        found = texts(pathlib.Path(crate["manifest_path"]).parent)
        if not expression and not found:
            sys.exit(f"{name}: no licence is declared")
        parts.append((name, expression or "see the text", found or standard(crate)))
    sysroot = subprocess.run(["rustc", "--print", "sysroot"], check=True, capture_output=True, text=True).stdout.strip()
    rustc = subprocess.run(["rustc", "--version"], check=True, capture_output=True, text=True).stdout.split()[1]
    copyright_notice = "Copyright (c) The Rust Project Contributors\nhttps://github.com/rust-lang/rust\n"
    rust = sorted(pathlib.Path(sysroot, "share/doc").glob("**/licenses/MIT.txt"))
    parts.append((f"Rust's standard library {rustc}", "MIT OR Apache-2.0",
                  [copyright_notice, *(file.read_text() for file in rust[:1] or [ROOT / "LICENSE-APACHE"])]))
    parts.extend((what, "see the text", [file.read_text().strip() + "\n"]) for what, file in OTHERS)

    numbers = {}
    for _, _, found in parts:
        for text in found:
            numbers.setdefault(text, len(numbers) + 1)
    print(f"flotilla for {target} contains the following, each under its own licence. The texts follow by number.\n")
    for name, expression, found in parts:
        print(f"{name}: {expression} (text {', '.join(str(numbers[text]) for text in found)})")
    for text, number in numbers.items():
        print(f"\n{'=' * 80}\nText {number}\n{'=' * 80}\n\n{text}", end="")


if __name__ == "__main__":
    main(*sys.argv[1:])
