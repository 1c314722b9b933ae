"""Tests the command `flotilla` of the package, and the functions that run its commands: compare, paper and verify."""

import json
import os
import pickle
import signal
import subprocess
import sys
import sysconfig
import time

import numpy as np
import pytest

import flotilla
from flotilla import Config, Run, train


def test_the_command_comes_with_the_package():
    command = os.path.join(sysconfig.get_path("scripts"), "flotilla")
    version = subprocess.run([command, "--version"], capture_output=True, text=True, check=True).stdout
    assert version.startswith(f"flotilla {flotilla.__version__}")
    wrong = subprocess.run([command, "train"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "CONFIG" in wrong.stderr
    failed = subprocess.run([command, "train", "nowhere.toml"], capture_output=True, text=True)
    assert failed.returncode == 1 and failed.stderr.startswith("error: nowhere.toml: cannot be read")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit of open files for one process")
def test_the_command_raises_the_limit_of_open_files(config, tmp_path):
    # Without a larger limit, a sweep of 16 points fails.
    grid = f'[grid]\n"learning.seed" = {list(range(16))}\n'
    (tmp_path / "grid.toml").write_text(config.replace(learning={"generations": 1}).to_toml() + grid)
    command = f"ulimit -S -n 48; exec '{sys.executable}' -m flotilla sweep grid.toml --out points --quiet --backend cpu"
    finished = subprocess.run(["sh", "-c", command], capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    assert len(list((tmp_path / "points/points").iterdir())) == 16


def test_run_json_has_the_command_line(config, program, tmp_path):
    (tmp_path / "c.toml").write_text(config.to_toml())
    program("train", "c.toml", "--out", "run", "--quiet")
    command = json.loads((tmp_path / "run/run.json").read_text())["command"]
    assert command.split()[0].endswith("flotilla") and command.endswith("train c.toml --out run --quiet")
    sweep = config.to_toml().replace("coupling = 3", "") + '[grid]\n"world.coupling" = [1, 2]\n'
    (tmp_path / "s.toml").write_text(sweep)
    script = program("sweep", "s.toml", "--slurm", "--shards", "2")
    assert command.split()[0] in script


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_an_interrupted_command_exits_with_75_and_offers_resume(config, tmp_path):
    (tmp_path / "c.toml").write_text(config.replace(learning={"generations": 100_000}).to_toml())
    words = [sys.executable, "-m", "flotilla", "train", "c.toml", "--out", "run", "--quiet", "--backend", "cpu"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as running:
        while not os.path.exists("run/metrics.csv") or os.path.getsize("run/metrics.csv") < 2000:
            assert running.poll() is None
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        message = running.communicate(timeout=60)[1]
    assert running.returncode == 75 and message.startswith("stopped: ") and "--resume" in message


def test_runs_are_compared(config):
    runs = [train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "Df")]
    comparison = flotilla.compare(runs)
    assert comparison["test"] == "mann-whitney" and len(comparison["comparisons"][0]["arms"]) == 2
    champion = comparison["comparisons"][0]["measures"][0]["arms"][0]
    assert champion["value"] == pytest.approx(runs[0].metrics["champion_g"][:, -1].mean())
    assert flotilla.compare(runs, paired=True)["test"] == "wilcoxon"
    with pytest.raises(ValueError, match="^at=99: "):
        flotilla.compare(runs, at=99)
    with pytest.raises(ValueError, match="no runs"):
        flotilla.compare([])
    with pytest.raises(flotilla.Error, match="no such folder"):
        flotilla.compare(["one", "two"])
    with pytest.raises(flotilla.Error, match="^/a/grid: no such folder"):
        flotilla.compare("/a/grid")
    with pytest.raises(ValueError, match="is one run"):
        flotilla.compare(runs[0])
    other = train(config, seed=8)
    with pytest.raises(ValueError, match="^paired=True: "):
        flotilla.compare([runs[0], other], paired=True)


def test_comparisons_are_tables(config):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    runs = [train(config.replace(learning={"fitness": fitness})) for fitness in ("G", "D", "Df")]
    comparison = flotilla.compare(runs, at=[0, "last"], reach=0.5)
    table, pairs = pandas.DataFrame(comparison), pandas.DataFrame(comparison.pairs)
    assert len(table) == 3 * 5 and len(pairs) == 3 * 5
    last = table[(table.measure == "best_g") & (table.generation == 6)]
    assert list(last.arm) == ["fitness G", "fitness D", "fitness Df"] and set(last.trials) == {2}
    assert np.allclose(last.value, [run.metrics["best_g"][:, -1].mean() for run in runs])
    assert set(table.reach.dropna()) == {0.5} and {"low", "high"} <= set(table.columns)
    assert {"arm", "other", "value", "low", "high", "a", "p", "p_holm"} <= set(pairs.columns)
    # What was an object is still read like one, and survives a pickle.
    again = pickle.loads(pickle.dumps(comparison))
    assert again == comparison and again.pairs == comparison.pairs and again["comparisons"][0]["generation"] == 6
    assert comparison[0]["measure"] == "champion_g" and len(comparison[:2]) == 2


def test_a_sweep_is_compared_by_its_folder(config):
    flotilla.sweep(config, grid={"world.coupling": [1, 2], "learning.fitness": ["G", "Df"]}, out="grid")
    rows = flotilla.compare("grid", by="world.coupling")
    assert rows == flotilla.compare(["grid"], by="world.coupling") and {row["where"] for row in rows} == {"fitness G", "fitness Df"}
    with pytest.raises(ValueError, match="name one by by=: "):
        flotilla.compare("grid")


def test_warnings_name_the_caller_s_file_and_python_s_arguments(config):
    # With fewer than six pairs, no test could decide.
    runs = [train(config.replace(learning={"fitness": fitness, "trials": 6})) for fitness in ("G", "Df")]
    with pytest.warns(RuntimeWarning, match="paired=True compares pair by pair") as warned:
        notes = flotilla.compare(runs)["notes"]
    assert {each.filename for each in warned} == {__file__} and "--" not in "".join(notes)
    alone = Config(world={"leaders": [[5, 5]], "pois": [[45, 45]], "steps": 1}, learning={"generations": 1, "trials": 1})
    calls = (lambda: train(alone), lambda: flotilla.sweep(alone, grid={"learning.seed": [1]}), lambda: train(alone, out="r"))
    for call in calls:
        with pytest.warns(RuntimeWarning, match="cannot be reached") as warned:
            call()
        assert {each.filename for each in warned} == {__file__}


def test_the_paper_is_reproduced():
    reproduced = flotilla.paper("paper", trials=2, generations=2, backend="cpu")
    assert len(reproduced["arms"]) >= 18 and os.path.exists("paper/claims.md")
    for arm in reproduced["arms"][:3]:
        assert Run.open(arm["folder"]).digest == arm["digest"]
    with pytest.raises(flotilla.Error, match="paper"):
        flotilla.paper("paper", trials=2, generations=2)


def test_devices_and_verify():
    devices = flotilla.devices()
    assert [device["index"] for device in devices] == list(range(len(devices)))
    if not devices:
        with pytest.raises(flotilla.Error, match="no GPU"):
            flotilla.verify(worlds=2)
        pytest.skip("no GPU to compare with the CPU")
    report = flotilla.verify(worlds=2, teams=8, adapter=0)
    assert report["equal"] and report["comparisons"][0]["worlds"] == 2
