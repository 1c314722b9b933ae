"""Builds the peers that this machine can run, runs them in turns with flotilla, and prints a Markdown table.

    python3 benches/peers/run.py [--layouts generally_forward,chaotic] [--teams 4096] [--rounds 5] [--backend cpu]
                                 [--flotilla target/release/flotilla] [--python PATH] [--paper] [--json FILE]

Needs nothing but the standard library. --python names an interpreter that has JAX and NumPy, if this one has not. A peer
that cannot run here is left out, and the reason is told on standard error. Rounds go A B C A B C, so that a slow spell
of the machine meets everyone; a ratio is the median over the rounds of flotilla's rate by the peer's of the same round.
"""

import argparse
import json
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
NAMES = ["generally_forward", "strictly_forward", "chaotic"]
ROLLOUT, GENERATION = "team_steps_per_s", "generation_team_steps_per_s"


class Unavailable(Exception):
    """A peer that cannot be run here, with the reason."""


def tell(message):
    print(message, file=sys.stderr, flush=True)


def call(command):
    """Standard output of `command`."""
    command = [str(word) for word in command]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise Unavailable(f"{command[0]}: {error.strerror}") from error
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or ["no message"]
        raise Unavailable(f"`{' '.join(command)}` ended with {done.returncode}: {said[-1]}")
    return done.stdout


def measure(command):
    """The JSON object that `command` prints as its last line, or as all of its output."""
    output = call(command).strip()
    for text in (output, output.splitlines()[-1] if output else ""):
        try:
            return json.loads(text)
        except json.JSONDecodeError:
            continue
    raise Unavailable(f"`{command[0]}` printed no JSON object")


def build(compiler, flags, source, binary):
    if shutil.which(compiler) is None:
        raise Unavailable(f"no {compiler} here")
    call([compiler, *flags, "-o", binary, HERE / source])
    return binary


def contenders(options, folder):
    """Name and command of everything to run; a command is a function of layout and round."""

    def flotilla():
        if not options.flotilla.exists():
            raise Unavailable(
                f"no {options.flotilla}: build it with `cargo build --release`, or name it with --flotilla"
            )
        flags = ["--teams", options.teams, "--backend", options.backend, "--json"]
        if options.instructions:
            flags += ["--instructions", options.instructions]
        return lambda layout, _: [options.flotilla, "bench", ROOT / "configs" / f"{layout}.toml", *flags]

    def cpp():
        flags = ["-std=c++20", "-O3", "-march=native", "-ffast-math", "-fopenmp"]
        binary = build("g++", flags, "episode.cpp", folder / "episode_cpp")
        return lambda layout, seed: [binary, layout, options.teams, options.repeats, seed]

    def cuda():
        if shutil.which("nvidia-smi") is None:
            raise Unavailable("no NVIDIA GPU here")
        binary = build(
            "nvcc", ["-std=c++17", "-O3", "-arch=native", "--use_fast_math"], "episode.cu", folder / "episode_cuda"
        )
        return lambda layout, seed: [binary, layout, options.teams, options.repeats, seed]

    def numpy():
        call([options.python, "-c", "import numpy"])
        flags = ["--teams", options.teams, "--repeats", options.repeats]
        return lambda layout, seed: [
            options.python, HERE / "paper_numpy.py", "--rollout", layout, *flags, "--seed", seed
        ]  # fmt: skip

    def jax(platform, *flags):
        def ready():
            call([options.python, "-c", f"import jax; jax.devices({platform!r})"])
            program = [options.python, HERE / "episode_jax.py"]
            return lambda layout, seed: [
                *program, layout, options.teams, options.repeats, seed, "--platform", platform, *flags
            ]  # fmt: skip

        return ready

    offered = {
        "flotilla": flotilla,
        "C++ loop": cpp,
        "JAX on the CPU": jax("cpu"),
        "JAX on the CPU, generation": jax("cpu", "--generation"),
        "NumPy": numpy,
        "JAX on the GPU": jax("cuda"),
        "JAX on the GPU, generation": jax("cuda", "--generation"),
        "CUDA kernel": cuda,
    }
    able = {}
    for name, ready in offered.items():
        try:
            able[name] = ready()
        except Unavailable as reason:
            tell(f"skipped {name}: {reason}")
    return able


def rounds(options, layout, able):
    """Every contender's JSON objects, round by round; one that fails is dropped from all later rounds."""
    results = {name: [] for name in able}
    for number in range(options.rounds):
        for name in [name for name in able if name in results]:
            try:
                results[name].append(measure(able[name](layout, number)))
                tell(f"{layout}, round {number + 1} of {options.rounds}: {name}")
            except Unavailable as reason:
                tell(f"dropped {name}: {reason}")
                del results[name]
    return results


def rate(lines, key):
    values = [line[key] for line in lines if key in line]
    return f"{statistics.median(values):.3g} ({min(values):.3g} to {max(values):.3g})" if values else ""


def ratio(ours, theirs, key):
    values = [a[key] / b[key] for a, b in zip(ours, theirs) if key in a and key in b]
    return f"{statistics.median(values):.2f}" if values else ""


def mean_g(lines):
    """Mean G of random teams over the rounds, each with its own seed, and the standard error of that mean."""
    lines = [line for line in lines if "sd_g" in line]
    if not lines:
        return ""
    teams = sum(line["teams"] for line in lines)
    variance = statistics.mean(line["sd_g"] ** 2 for line in lines)
    return f"{statistics.mean(line['mean_g'] for line in lines):.4f} ± {math.sqrt(variance / teams):.4f}"


def table(layout, results, options):
    ours = results.get("flotilla", [])
    if ours:
        where = ours[0].get("adapter") or options.instructions or "its widest instructions"
        print(f"\n{layout}, {options.teams} teams; flotilla on {ours[0].get('backend')} ({where})\n")
    else:
        print(f"\n{layout}, {options.teams} teams; without flotilla\n")
    print(
        "| | rollout, team-steps/s | flotilla is × | generation, team-steps/s | flotilla is × | mean G of random teams |"
    )
    print("|---|---|---|---|---|---|")
    for name, lines in results.items():
        times = ["", ""] if name == "flotilla" else [ratio(ours, lines, key) for key in (ROLLOUT, GENERATION)]
        print(
            f"| {name} | {rate(lines, ROLLOUT)} | {times[0]} | {rate(lines, GENERATION)} | {times[1]} | {mean_g(lines)} |"
        )
    sys.stdout.flush()


def paper(options):
    """The paper's 18 experiments: flotilla's whole commands, a sweep a layout, by the clock, against the NumPy program
    scaled up from a tenth."""
    grid = '\n[grid]\n"learning.paradigm" = ["leader-follower", "all-leaders"]\n"learning.fitness" = ["G", "D", "Df"]\n'
    batches = {"all": "all trials of an arm side by side", "run": "one training run at a time"}
    ours, theirs = [], {batch: [] for batch in batches}
    for number in range(options.rounds):
        with tempfile.TemporaryDirectory() as out:
            sweeps = [Path(out) / f"{layout}.toml" for layout in NAMES]
            for sweep in sweeps:
                sweep.write_text((ROOT / "configs" / sweep.name).read_text() + grid)
            begin = time.perf_counter()
            for sweep in sweeps:
                call([options.flotilla, "sweep", sweep, "--backend", options.backend, "--out", Path(out) / sweep.stem])
            ours.append(time.perf_counter() - begin)
        for batch, seconds in theirs.items():
            command = [options.python, HERE / "paper_numpy.py", "--trials", 5, "--fraction", options.fraction]
            seconds.append(measure([*command, "--batch", batch, "--seed", number, "--json"])["paper_seconds"])
        numpy = ", ".join(f"{seconds[-1]:.1f} s ({batch})" for batch, seconds in theirs.items())
        tell(f"paper, round {number + 1} of {options.rounds}: flotilla {ours[-1]:.2f} s, NumPy {numpy}")
    print("\n| the paper's 18 experiments | seconds | flotilla is × |\n|---|---|---|")
    print(f"| flotilla sweep for each layout, start-up and pictures included | {statistics.median(ours):.2f} | |")
    for batch, seconds in theirs.items():
        times = statistics.median(b / a for a, b in zip(ours, seconds))
        name = f"NumPy, {batches[batch]}, from {options.fraction:g} of the generations"
        print(f"| {name} | {statistics.median(seconds):.1f} | {times:.1f} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layouts", default="generally_forward,chaotic", help="names with commas between them")
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--repeats", type=int, default=3, help="rollouts a peer times in one round; their median counts"
    )
    parser.add_argument("--backend", default="auto", help="flotilla's backend: auto, cpu or gpu")
    parser.add_argument("--instructions", help="instruction set of flotilla's CPU backend, as SSE2, AVX2 or AVX-512")
    parser.add_argument("--flotilla", type=Path, default=ROOT / "target" / "release" / "flotilla")
    parser.add_argument("--python", default=sys.executable, help="an interpreter with JAX and NumPy")
    parser.add_argument("--paper", action="store_true", help="time the complete paper instead")
    parser.add_argument("--fraction", type=float, default=0.1, help="part of the paper that NumPy runs")
    parser.add_argument("--json", type=Path, help="also write every measurement to this file")
    options = parser.parse_args()
    layouts = options.layouts.split(",")
    for layout in layouts:
        if layout not in NAMES:
            parser.error(f"no layout {layout!r}: choose from {', '.join(NAMES)}")
    if options.paper:
        try:
            return paper(options)
        except Unavailable as reason:
            sys.exit(f"error: {reason}")
    with tempfile.TemporaryDirectory() as folder:
        able = contenders(options, Path(folder))
        everything = {}
        for layout in layouts:
            everything[layout] = rounds(options, layout, able)
            table(layout, everything[layout], options)
    if options.json:
        options.json.write_text(json.dumps(everything, indent=1))


main()
