"""Times a step of an agent in large teams: python3 benches/swarms.py FLOTILLA [INSTRUCTIONS]

Followers fill a box so that each has about so many others within its radius, and hardly move. One thread, random policies, median
of what `flotilla bench` repeats.
"""

import json
import math
import pathlib
import subprocess
import sys
import tempfile

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

flotilla, *instructions = sys.argv[1:]
print("| agents | neighbours | ns per agent-step |\n|---|---|---|")
for agents in [10**3, 10**4, 10**5, 10**6]:
    for neighbours in [10, 50, 200]:
        side = round(max(5, math.sqrt(agents * math.pi / neighbours)), 3)
        config = pathlib.Path(tempfile.mkdtemp()) / "swarm.toml"
        config.write_text(CONFIG.format(agents=agents, side=side, middle=side / 2))
        teams = max(2, 10**5 // agents)
        command = [flotilla, "bench", config, "--teams", teams, "--rollout-only", "--threads", 1, "--json", "--backend", "cpu"]
        command += ["--instructions", *instructions] if instructions else []
        found = json.loads(subprocess.run([str(word) for word in command], capture_output=True, check=True).stdout)
        print(f"| {agents} | {neighbours} | {found['ns_per_agent_step']:.0f} |", flush=True)
