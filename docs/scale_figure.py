"""Draws docs/pictures/scale.svg: G of champions at coupling 6, by the number of teams played.

    pip install matplotlib scipy
    python3 docs/scale_figure.py                 # from docs/results/scale/coupling6-curves.csv
    python3 docs/scale_figure.py SWEEP...        # writes that file first, from equal-* of docs/results/scale-tables.md
"""

import csv
import io
import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
CURVES = HERE / "results/scale/coupling6-curves.csv"
FITNESS = "Df"
# Trials by number of policies.
TRIALS = {50: 5, 500: 5, 5000: 5, 50000: 10}
TITLE = "G of the champion at coupling 6, by the number of teams played"
DESCRIPTION = (
    "On a logarithmic axis, for 50, 500, 5000 and 50 000 policies that play equally many teams: leader-follower "
    "champions end between 0.7 and 1, the higher the larger the population; all-leaders champions rise late, to "
    "0.45 with 500 policies and to between 0.1 and 0.28 with the others."
)


def read(sweeps):
    """Returns rows (paradigm, population, teams, mean, standard error) of the champion's G, thinned out."""
    rows = []
    for point in sorted(point for sweep in sweeps for point in Path(sweep).glob("points/*")):
        learning = tomllib.loads((point / "config.toml").read_text())["learning"]
        if learning["fitness"] != FITNESS:
            continue
        by_generation = {}
        with open(point / "metrics.csv", newline="") as file:
            for row in csv.DictReader(file):
                by_generation.setdefault(int(row["generation"]), []).append(float(row["champion_g"]))
        shown = 0
        for generation, values in sorted(by_generation.items()):
            # About 47 points per factor of ten. The last generation is always shown.
            if generation + 1 < shown * 1.05 and generation != max(by_generation):
                continue
            shown = generation + 1
            mean = sum(values) / len(values)
            variance = sum((value - mean) ** 2 for value in values) / max(len(values) - 1, 1)
            teams = learning["population"] * (generation + 1)
            error = (variance / len(values)) ** 0.5
            rows.append([learning["paradigm"], learning["population"], teams, f"{mean:.4f}", f"{error:.4f}"])
    return rows


def interval(mean, error, trials):
    """Returns the 95 % interval of a mean of G, with 0 and 1 as two more values, as on the page on statistics."""
    from scipy import stats

    squares = error**2 * trials * (trials - 1) + 0.5 + (mean - 0.5) ** 2 * 2 * trials / (trials + 2)
    middle = (mean * trials + 1) / (trials + 2)
    half = stats.t.ppf(0.975, trials + 1) * (squares / (trials + 1) / (trials + 2)) ** 0.5
    return max(middle - half, 0), min(middle + half, 1)


def draw():
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "flotilla", "font.size": 11})
    import matplotlib.pyplot as plt

    curves = {}
    with open(CURVES, newline="") as file:
        for row in csv.DictReader(file):
            curve = curves.setdefault((row["paradigm"], int(row["population"])), [])
            curve.append([float(row[key]) for key in ("teams", "champion_g", "standard_error")])
    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    # Each line has its own shade, dashes and end label. A larger population is darker.
    styles = {50: ":", 500: "--", 5000: "-.", 50000: "-"}
    shades = {
        "leader-follower": {50: "#6baed6", 500: "#3182bd", 5000: "#08519c", 50000: "#08244f"},
        "all-leaders": {50: "#fd8d3c", 500: "#e6550d", 5000: "#a63603", 50000: "#5b1a00"},
    }
    for (paradigm, population), curve in sorted(curves.items(), key=lambda item: (item[0][0], item[0][1])):
        colour = shades[paradigm][population]
        teams, mean, error = zip(*curve)
        label = f"{population} policies".replace("50000", "50 000")
        axes.plot(teams, mean, styles[population], color=colour, linewidth=1.8, label=label)
        # All lines end near the same number of teams. Their intervals stand beside each other there.
        place = teams[-1] * (1.06 + 0.14 * list(styles).index(population) + 0.07 * (paradigm == "all-leaders"))
        low, high = interval(mean[-1], error[-1], TRIALS[population])
        ends = [[mean[-1] - low], [high - mean[-1]]]
        axes.errorbar(place, mean[-1], ends, marker="o", markersize=3, color=colour, linewidth=1)
    axes.set(xlabel="teams played (at the right: the last means with their 95 % intervals)", ylabel="G of the champion, mean over trials", xscale="log", ylim=(-0.02, 1.02))
    handles, labels = axes.get_legend_handles_labels()
    for paradigm, first, place in (("all-leaders", 0, (0.22, 1.0)), ("leader-follower", 4, (0.0, 1.0))):
        legend = axes.legend(handles[first:first + 4], labels[first:first + 4], title=paradigm, loc="upper left",
                             bbox_to_anchor=place, frameon=False, fontsize=9, title_fontsize=9, alignment="left")
        if first == 0:
            axes.add_artist(legend)
    axes.spines[["top", "right"]].set_visible(False)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    # Matplotlib writes no title and description, which screen readers need.
    head, rest = text.getvalue().split("<svg ", 1)
    attributes, body = rest.split(">\n <metadata>", 1)
    described = (
        f'{head}<svg role="img" aria-labelledby="title description" {attributes}>\n<title id="title">{TITLE}</title>\n'
        f'<desc id="description">{DESCRIPTION}</desc>\n<metadata>{body}'
    )
    (HERE / "pictures/scale.svg").write_text(described)


if sys.argv[1:]:
    with open(CURVES, "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["paradigm", "population", "teams", "champion_g", "standard_error"])
        table.writerows(read(sys.argv[1:]))
draw()
