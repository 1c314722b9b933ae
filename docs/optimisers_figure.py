"""Draws docs/pictures/optimisers.svg: G that optimisers found on the tasks, and where they ended.

    pip install matplotlib
    python3 docs/optimisers_figure.py

The input is docs/results/tasks/optimisers.csv.
"""

import csv
import io
from pathlib import Path
from statistics import mean

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams.update({"svg.hashsalt": "flotilla", "font.size": 11})
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
EPISODES = "505000"
TITLE = "G of the best team found and of the last one, by task and optimiser, after 505 000 episodes"
DESCRIPTION = (
    "Tournaments of one shared policy end where they found their best team, and best or tied in six of eight tasks. "
    "CMA-ES with a shared policy ends best in decoy, tournaments of separate policies in route. The other "
    "optimisers end below what they found."
)
OPTIMISERS = [
    ("tournament-shared", "tournament, one shared policy", "#0072b2"),
    ("tournament-own", "tournament, separate policies", "#56b4e9"),
    ("cma-shared", "CMA-ES, shared", "#d55e00"),
    ("cma-own", "CMA-ES, separate", "#e69f00"),
    ("openai-es-shared", "OpenAI-ES, shared", "#009e73"),
    ("openai-es-own", "OpenAI-ES, separate", "#999999"),
]

cells = {}
with open(HERE / "results/tasks/optimisers.csv", newline="") as file:
    for row in csv.DictReader(file):
        if row["episodes"] == EPISODES:
            cells.setdefault((row["optimiser"], row["task"]), []).append((float(row["found"]), float(row["end"])))
tasks = sorted({task for _, task in cells})

figure, axes = plt.subplots(figsize=(8.6, 4.4), layout="constrained")
for place, (optimiser, label, colour) in enumerate(OPTIMISERS):
    shown = [(at, cells[optimiser, task]) for at, task in enumerate(tasks) if (optimiser, task) in cells]
    x = [at + (place - 2.5) * 0.13 for at, _ in shown]
    found, end = ([mean(trial[part] for trial in trials) for _, trials in shown] for part in (0, 1))
    axes.vlines(x, end, found, color=colour, linewidth=1.2)
    axes.scatter(x, found, s=26, facecolors="white", edgecolors=colour, zorder=3)
    axes.scatter(x, end, s=26, color=colour, label=label, zorder=4)
axes.axhline(0.9, color="#888888", linewidth=0.8, linestyle=":")
axes.set(ylabel="G, mean of 5 trials", ylim=(0, 1.04), xlim=(-0.5, len(tasks) - 0.5))
axes.set_xticks(range(len(tasks)), tasks)
figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=10)
axes.text(len(tasks) - 0.5, 0.02, "hollow: best team found; filled: at the end; dotted: 0.9", ha="right", color="#555555", fontsize=9)
axes.spines[["top", "right"]].set_visible(False)
text = io.StringIO()
figure.savefig(text, format="svg", metadata={"Date": None})
# Matplotlib writes no title and description, which screen readers need.
described = '''<svg role="img" aria-labelledby="title description" ''', f'''>
<title id="title">{TITLE}</title>
<desc id="description">{DESCRIPTION}</desc>
<metadata>'''
head, rest = text.getvalue().split("<svg ", 1)
attributes, body = rest.split(">\n <metadata>", 1)
(HERE / "pictures/optimisers.svg").write_text(head + described[0] + attributes + described[1] + body)
