"""Times a step of an agent in large teams: python3 benches/swarms.py FLOTILLA [INSTRUCTIONS]

Followers fill a box so that each has about so many others within its radius, and hardly move. One thread, random policies, median
of what `flotilla bench` repeats. The last columns are shares of what the core reaches: chains of f32 operations in registers, and a
copy of an array. A step reads and writes six numbers of each agent, does so again to sort them by cell, and finds the cells.
"""

import json
import math
import pathlib
import subprocess
import sys
import tempfile
import time

BYTES = 4 * (6 + 6 + 6 + 6 + 2 + 1 + 1)  # per agent and step, at least

CONFIG = """
[world]
map = [{side}, {side}]
steps = 20

[[agents]]
name = "leader"
at = [[1.0, 1.0]]
senses = [{{ of = "pois" }}]
leads = "follower"
influence_radius = 2.0

[[agents]]
name = "follower"
count = {agents}
in = {{ box = [0.0, 0.0, {side}, {side}] }}
control = "follow"
motion = {{ kind = "steered", max_speed = 0.5 }}
rule = [
    {{ of = "follower", to = 0.3, gain = -1.0 }},
    {{ of = "follower", from = 0.3, to = 1.0, gain = 0.2 }},
]

[[pois]]
name = "poi"
at = [[{middle}, {middle}]]
coupling = 10
radius = 2.0

[learning]
fitness = "G"
"""


def copied_per_ns():
    """Returns the bytes that a copy of a large array reads and writes."""
    numbers, copy, times = bytearray(1 << 28), bytearray(1 << 28), []
    for _ in range(9):
        start = time.perf_counter_ns()
        memoryview(copy)[:] = numbers
        times.append(time.perf_counter_ns() - start)
    return 2 * len(numbers) / sorted(times)[4]


flotilla, *instructions = sys.argv[1:]
bandwidth = copied_per_ns()
print("| agents | neighbours | ns per agent-step | of arithmetic | of bandwidth |\n|---|---|---|---|---|")
for agents in [10**3, 10**4, 10**5, 10**6]:
    for neighbours in [10, 50, 200]:
        side = round(max(5, math.sqrt(agents * math.pi / neighbours)), 3)
        config = pathlib.Path(tempfile.mkdtemp()) / "swarm.toml"
        config.write_text(CONFIG.format(agents=agents, side=side, middle=side / 2))
        teams = max(2, 10**5 // agents)
        command = [flotilla, "bench", config, "--teams", teams, "--rollout-only", "--threads", 1, "--json", "--backend", "cpu"]
        command += ["--instructions", *instructions] if instructions else []
        found = json.loads(subprocess.run([str(word) for word in command], capture_output=True, check=True).stdout)
        time_of_step = found["ns_per_agent_step"]
        shares = f"{found['ceiling_share']:.0%} | {BYTES / time_of_step / bandwidth:.0%}"
        print(f"| {agents} | {neighbours} | {time_of_step:.0f} | {shares} |", flush=True)
