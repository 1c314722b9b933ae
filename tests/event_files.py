"""Reads a run's event files by TensorBoard itself, and compares them with its metrics.csv.

    python3 tests/event_files.py RUN        (a run trained with --tensorboard; needs the package tensorboard)
"""

import csv
import pathlib
import sys

from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.util import tensor_util

TAGS = ["best_g", "mean_g", "champion_g"]


def main():
    run = pathlib.Path(sys.argv[1])
    with open(run / "metrics.csv", newline="") as file:
        expected = {(int(row["trial"]), int(row["generation"])): [float(row[tag]) for tag in TAGS] for row in csv.DictReader(file)}
    assert expected, "metrics.csv has no rows"

    everything = EventMultiplexer(tensor_size_guidance={"scalars": 0}).AddRunsFromDirectory(str(run / "tensorboard"))
    everything.Reload()
    found = {}
    for name, tags in everything.Runs().items():
        trial = int(name.removeprefix("trial-"))
        assert sorted(tags["tensors"]) == sorted(TAGS), tags
        for place, tag in enumerate(TAGS):
            assert everything.SummaryMetadata(name, tag).plugin_data.plugin_name == "scalars"
            for event in everything.Tensors(name, tag):
                values = found.setdefault((trial, event.step), [None] * len(TAGS))
                assert values[place] is None, f"{name} has {tag} of generation {event.step} twice"
                values[place] = tensor_util.make_ndarray(event.tensor_proto).item()
    assert found == expected, "the event files and metrics.csv differ"
    print(f"{len(found)} rows of {len(everything.Runs())} trials are the same in TensorBoard as in metrics.csv")


main()
