"""Compares the speed of flotilla and the peers that this machine can run, and prints a Markdown table.

    python3 benches/peers/run.py [--layouts generally_forward,chaotic] [--teams 4096] [--rounds 5] [--backend cpu]
                                 [--flotilla target/release/flotilla] [--python PATH] [--paper] [--json FILE]

This script needs only the standard library. --python names an interpreter with JAX and NumPy, if this one has none. A
peer that cannot run here is left out, and the reason is printed to standard error. Rounds have the order A B C A B C,
so that slow phases of the machine affect all programs alike. Each ratio is the median over rounds of flotilla's rate
divided by the peer's rate in the same round.
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
    """The reason why a peer cannot run here."""


def report(message):
    print(message, file=sys.stderr, flush=True)


def call(command):
    """Runs a command and returns its standard output."""
    command = [str(word) for word in command]
    try:
        finished = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise Unavailable(f"{command[0]}: {error.strerror}") from error
    if finished.returncode != 0:
        message = finished.stderr.strip().splitlines() or ["no message"]
        raise Unavailable(f"`{' '.join(command)}` failed with exit code {finished.returncode}: {message[-1]}")
    return finished.stdout


def measure(command):
    """Runs a command and returns the JSON object that is its last line, or its whole output."""
    output = call(command).strip()
    for text in (output, output.splitlines()[-1] if output else ""):
        try:
            return json.loads(text)
        except json.JSONDecodeError:
            continue
    raise Unavailable(f"`{command[0]}` printed no JSON object")


def build(compiler, flags, source, binary):
    if shutil.which(compiler) is None:
        raise Unavailable(f"no {compiler} on this machine")
    call([compiler, *flags, "-o", binary, HERE / source])
    return binary


def contenders(options, folder):
    """Returns names and commands of the programs to run. A command is a function of the layout and the round."""

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
            raise Unavailable("no NVIDIA GPU on this machine")
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
        def prepare():
            call([options.python, "-c", f"import jax; jax.devices({platform!r})"])
            program = [options.python, HERE / "episode_jax.py"]
            return lambda layout, seed: [
                *program, layout, options.teams, options.repeats, seed, "--platform", platform, *flags
            ]  # fmt: skip

        return prepare

    programs = {
        "flotilla": flotilla,
        "C++ loop": cpp,
        "JAX on the CPU": jax("cpu"),
        "JAX on the CPU, generation": jax("cpu", "--generation"),
        "NumPy": numpy,
        "JAX on the GPU": jax("cuda"),
        "JAX on the GPU, generation": jax("cuda", "--generation"),
        "CUDA kernel": cuda,
    }
    commands = {}
    for name, prepare in programs.items():
        try:
            commands[name] = prepare()
        except Unavailable as reason:
            report(f"skipped {name}: {reason}")
    return commands


def rounds(options, layout, commands):
    """Returns the JSON objects of every program, by round. A program that fails is left out of all later rounds."""
    results = {name: [] for name in commands}
    for number in range(options.rounds):
        for name in [name for name in commands if name in results]:
            try:
                results[name].append(measure(commands[name](layout, number)))
                report(f"{layout}, round {number + 1} of {options.rounds}: {name}")
            except Unavailable as reason:
                report(f"dropped {name}: {reason}")
                del results[name]
    return results


def rate(lines, key):
    values = [line[key] for line in lines if key in line]
    return f"{statistics.median(values):.3g} ({min(values):.3g} to {max(values):.3g})" if values else ""


def ratio(ours, theirs, key):
    values = [a[key] / b[key] for a, b in zip(ours, theirs) if key in a and key in b]
    return f"{statistics.median(values):.2f}" if values else ""


def mean_g(lines):
    """Returns the mean G of random teams over the rounds, each with its own seed, and the standard error."""
    lines = [line for line in lines if "sd_g" in line]
    if not lines:
        return ""
    teams = sum(line["teams"] for line in lines)
    variance = statistics.mean(line["sd_g"] ** 2 for line in lines)
    return f"{statistics.mean(line['mean_g'] for line in lines):.4f} ± {math.sqrt(variance / teams):.4f}"


def table(layout, results, options):
    ours = results.get("flotilla", [])
    if ours:
        device = ours[0].get("adapter") or options.instructions or "its widest instructions"
        print(f"\n{layout}, {options.teams} teams; flotilla on {ours[0].get('backend')} ({device})\n")
    else:
        print(f"\n{layout}, {options.teams} teams; without flotilla\n")
    print(
        "| | rollout, team-steps/s | flotilla / peer | generation, team-steps/s | flotilla / peer "
        "| mean G of random teams |"
    )
    print("|---|---|---|---|---|---|")
    for name, lines in results.items():
        times = ["", ""] if name == "flotilla" else [ratio(ours, lines, key) for key in (ROLLOUT, GENERATION)]
        rollout, generation = rate(lines, ROLLOUT), rate(lines, GENERATION)
        print(f"| {name} | {rollout} | {times[0]} | {generation} | {times[1]} | {mean_g(lines)} |")
    sys.stdout.flush()


def paper(options):
    """Compares the time of the paper's 18 experiments.

    flotilla's time is that of whole commands, one sweep per layout. The NumPy program runs a part of the generations,
    and scales its time up.
    """
    grid = '\n[grid]\n"learning.paradigm" = ["leader-follower", "all-leaders"]\n"learning.fitness" = ["G", "D", "Df"]\n'
    batches = {"all": "all trials of an experiment at once", "run": "one training run at a time"}
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
        report(f"paper, round {number + 1} of {options.rounds}: flotilla {ours[-1]:.2f} s, NumPy {numpy}")
    print("\n| the paper's 18 experiments | seconds | peer / flotilla |\n|---|---|---|")
    print(f"| flotilla sweep for each layout, start-up and pictures included | {statistics.median(ours):.2f} | |")
    for batch, seconds in theirs.items():
        times = statistics.median(b / a for a, b in zip(ours, seconds))
        name = f"NumPy, {batches[batch]}, from {options.fraction:g} of the generations"
        print(f"| {name} | {statistics.median(seconds):.1f} | {times:.1f} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layouts", default="generally_forward,chaotic", help="comma-separated names")
    parser.add_argument("--teams", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--repeats", type=int, default=3, help="rollouts per peer and round, of which the median counts"
    )
    parser.add_argument("--backend", default="auto", help="flotilla's backend: auto, cpu or gpu")
    parser.add_argument("--instructions", help="instruction set of flotilla's CPU backend: SSE2, AVX2 or AVX-512")
    parser.add_argument("--flotilla", type=Path, default=ROOT / "target" / "release" / "flotilla")
    parser.add_argument("--python", default=sys.executable, help="an interpreter with JAX and NumPy")
    parser.add_argument("--paper", action="store_true", help="time the paper's experiments instead")
    parser.add_argument("--fraction", type=float, default=0.1, help="share of the generations that NumPy runs")
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
        commands = contenders(options, Path(folder))
        results = {}
        for layout in layouts:
            results[layout] = rounds(options, layout, commands)
            table(layout, results[layout], options)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


main()
