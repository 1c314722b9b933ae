"""How long UAVs stay with rovers: python3 docs/influence_near.py POINTS > docs/results/influence/near.csv

POINTS is the folder `points` of a layout that `flotilla paper --influence` trained. Of each credit: the share of steps, over UAVs and
trials, at which a champion's UAV has a rover within 5 units, in the first episode from the config's own starts.
"""

import csv
import io
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile

(points,) = sys.argv[1:]
print("fitness,led_by,trials,share,deviation")
for point in sorted(pathlib.Path(points).iterdir()):
    text = (point / "config.toml").read_text()
    word = lambda key: re.search(f'^{key} = "([^"]+)"', text, re.M)[1]
    count = int(re.search(r"^trials = (\d+)", text, re.M)[1])
    shares = []
    with tempfile.TemporaryDirectory() as folder:
        trace = pathlib.Path(folder) / "trace.csv"
        for trial in range(count):
            command = ["flotilla", "rollout", point, "--trial", str(trial), "--trace", trace, "--quiet", "--backend", "cpu"]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            places = {}
            for row in csv.DictReader(io.StringIO(trace.read_text())):
                if row["team"] == "0":
                    places.setdefault(int(row["step"]), []).append(complex(float(row["x"]), float(row["y"])))
            # Rovers are the first half of the agents.
            near = [
                any(abs(uav - rover) <= 5 for rover in agents[: len(agents) // 2])
                for agents in places.values()
                for uav in agents[len(agents) // 2 :]
            ]
            shares.append(statistics.mean(near))
    share, deviation = statistics.mean(shares), statistics.stdev(shares)
    print(f"{word('fitness')},{word('led_by')},{count},{share:.4f},{deviation:.4f}", flush=True)
