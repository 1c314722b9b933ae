import filecmp
import json
import os
import pathlib
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from conftest import random_config

import flotilla
from flotilla import Config, Run, train

PAPER = [(layout, paradigm) for layout in ("generally_forward", "strictly_forward", "chaotic") for paradigm in ("leader-follower", "all-leaders")]


def same_as_the_program(config, program, tmp_path):
    """Trains in memory, in a folder and by the program: one digest, and one file of policies."""
    (tmp_path / "config.toml").write_text(config.to_toml())
    program("train", "config.toml", "--out", "theirs", "--backend", "cpu", "--quiet")
    theirs = Run.open("theirs")
    ours = train(config, backend="cpu", progress=False)
    ours.save("saved")
    kept = train(config, out="kept", backend="cpu")
    told = json.loads((tmp_path / "theirs/run.json").read_text())["digest"]
    assert {ours.digest, kept.digest, theirs.digest, Run.open("saved").digest} == {told}
    for folder in ("saved", "kept"):
        assert filecmp.cmp("theirs/policies.safetensors", f"{folder}/policies.safetensors", shallow=False)
        assert filecmp.cmp("theirs/config.toml", f"{folder}/config.toml", shallow=False)
    for one, other in zip(ours.policies, theirs.policies):
        assert np.array_equal(one.view(np.uint32), other.view(np.uint32))
    for name, values in ours.metrics.items():
        assert np.array_equal(values, theirs.metrics[name])
    assert ours.config == theirs.config == config


@pytest.mark.parametrize("layout, paradigm", PAPER)
def test_the_paper_s_configs_come_to_what_the_program_comes_to(layout, paradigm, program, tmp_path):
    config = Config.paper(layout, paradigm=paradigm).replace(learning={"generations": 4, "trials": 2})
    same_as_the_program(config, program, tmp_path)


@pytest.mark.parametrize("seed", range(6))
def test_random_configs_come_to_what_the_program_comes_to(seed, program, tmp_path):
    same_as_the_program(random_config(seed), program, tmp_path)


def test_arrays_have_their_shapes(config):
    run = train(config, seed=3)
    assert run.config["learning.seed"] == 3
    for name in ("best_g", "mean_g", "champion_g"):
        assert run.metrics[name].shape == (2, 7) and run.metrics[name].dtype == np.float64
    assert [trial.shape for trial in run.policies] == [(4, 20, 112)] * 2
    assert run.policies[0].dtype == np.float32 and run.policies[0].flags.c_contiguous
    assert run.digest != train(config, seed=4).digest
    again = pickle.loads(pickle.dumps(run))
    assert again.digest == run.digest and again.config == run.config
    assert repr(run).startswith("<flotilla.Run: 2 trials, 6 generations, best G ")


def test_the_program_goes_on_with_what_was_trained_here(config, program):
    train(config, out="run")
    program("train", "run/config.toml", "--out", "run", "--resume", "--generations", "9", "--quiet")
    longer = config.replace(learning={"generations": 9})
    assert Run.open("run").digest == train(longer).digest
    train(config).save("memory")
    program("train", "memory/config.toml", "--out", "memory", "--resume", "--generations", "9", "--quiet")
    assert Run.open("memory").digest == train(longer).digest
    program("plot", "memory")
    program("replay", "memory")
    assert os.path.exists("memory/replay.html")


def files_of(folder):
    """The files of a run by name, without times, paths and who wrote them."""

    def content(path):
        data = path.read_bytes()
        if path.name == "metrics.csv":
            return [line.rsplit(b",", 1)[0] for line in data.splitlines()]
        if path.name == "run.json":
            who = ("started", "updated", "seconds", "command", "commit")
            return {key: value for key, value in json.loads(data).items() if key not in who}
        if path.parent.name == "checkpoints":
            length = int.from_bytes(data[:8], "little")
            header = json.loads(data[8 : 8 + length])
            for key in ("seconds", "metrics_bytes", "metrics_sha256", "sha256"):
                header["__metadata__"].pop(key, None)
            return header, data[8 + length :]
        return data

    return {str(path.relative_to(folder)): content(path) for path in pathlib.Path(folder).rglob("*") if path.is_file()}


@pytest.mark.parametrize("method", ["tournament", "openai-es"])
def test_a_run_has_the_same_files_however_it_was_trained(config, program, tmp_path, method):
    config = config.replace(learning={"method": method})
    (tmp_path / "config.toml").write_text(config.to_toml())
    program("train", "config.toml", "--out", "theirs", "--backend", "cpu", "--quiet")
    train(config, out="ours", backend="cpu")
    train(config, backend="cpu").save("saved")
    Run.open("theirs").save("copy")
    pickle.loads(pickle.dumps(train(config, backend="cpu"))).save("pickled")
    copies = ("ours", "saved", "copy", "pickled")
    expected = files_of("theirs")
    assert {"config.toml", "curves.svg", "metrics.csv", "policies.safetensors", "run.json"} < set(expected)
    longer = train(config.replace(learning={"generations": 16}), backend="cpu").digest
    for folder in copies:
        found = files_of(folder)
        assert found.keys() == expected.keys(), folder
        for name, content in expected.items():
            assert found[name] == content, (folder, name)
    for folder in ("theirs", *copies):
        extended = program("train", f"{folder}/config.toml", "--out", folder, "--resume", "--generations", "16", "--json", "--backend", "cpu")
        extended = json.loads(extended)
        # Nothing that was trained before is trained again.
        assert (extended["digest"], extended["trained_generations"]) == (longer, 10), folder


@pytest.mark.parametrize("out", [None, "run"])
def test_a_config_that_is_likely_a_mistake_is_warned_of(config, out):
    with pytest.warns(RuntimeWarning, match="degrees"):
        train(config.replace(world={"heading": 90.0}), out=out)
    with pytest.warns(RuntimeWarning, match="cannot be reached"):
        train(config.replace(world={"steps": 2}), out=out, force=out is not None)


def test_a_folder_is_gone_on_with_or_written_over(config):
    first = train(config, out="run")
    with pytest.raises(FileExistsError, match="run"):
        train(config, out="run")
    assert train(config, out="run", resume=True).digest == first.digest
    other = config.replace(learning={"seed": 5})
    with pytest.raises(flotilla.Error, match="learning.seed"):
        train(other, out="run", resume=True)
    assert train(other, out="run", force=True).digest != first.digest
    with pytest.raises(FileExistsError):
        first.save("run")
    first.save("run", force=True)
    assert Run.open("run").digest == first.digest
    with pytest.raises(ValueError, match="out"):
        train(config, resume=True)


def test_a_run_is_whole_without_its_picture(config):
    os.makedirs("run/curves.svg/full")
    with pytest.raises(flotilla.Error, match="curves.svg"):
        train(config, out="run")
    assert os.listdir("run") == ["curves.svg"]
    # A run that resumes is not held up by a picture.
    with pytest.warns(RuntimeWarning, match="curves.svg"):
        run = train(config, out="run", resume=True)
    assert Run.open("run").digest == run.digest


def test_a_training_starts_from_what_another_came_to(config, program):
    first = train(config, out="first")
    second = config.replace(learning={"fitness": "G", "population": 30, "seed": 9})
    warm = train(second, out="warm", init=first)
    program("train", "warm/config.toml", "--init", "first/policies.safetensors", "--out", "theirs", "--backend", "cpu", "--quiet")
    assert warm.digest == Run.open("theirs").digest != train(second).digest
    assert train(second, out="again", init="first/policies.safetensors").digest == warm.digest
    assert train(second, out="from memory", init=train(config)).digest == warm.digest
    # Its generation 0 is kept, so that it is gone on with and replayed without what it started from.
    assert train(second, out="warm", resume=True).digest == warm.digest
    assert [episode.generation for episode in warm.replay(compare=0).episodes] == [0, 6]
    # A copy says what it started from, which it has not.
    warm.save("copy")
    assert Run.open("copy").digest == warm.digest
    # With the times of the one that it was read from.
    assert filecmp.cmp("copy/metrics.csv", "warm/metrics.csv", shallow=False)
    with pytest.raises(flotilla.Error, match="started from given policies"):
        Run.open("copy").replay()
    # It keeps the last checkpoint, so that it is extended without what it started from.
    longer = second.replace(learning={"generations": 9})
    assert train(longer, out="copy", resume=True).digest == train(longer, init=first).digest
    # Without the checkpoint it would start over.
    warm.save("bare")
    shutil.rmtree("bare/checkpoints")
    with pytest.raises(flotilla.Error, match="can only start again from these"):
        train(longer, out="bare", resume=True)
    stopped = train(second, out="stopped", init=first, callback=lambda generation: generation.generation == 2)
    assert stopped.replay(compare=0).episodes[0].generation == 0
    assert train(second, init=first).digest == warm.digest
    with pytest.raises(flotilla.Error, match="nowhere"):
        train(second, out="other", init="nowhere/policies.safetensors")
    wider = second.replace(policy={"hidden": [3]})
    with pytest.raises(flotilla.Error, match="first/policies.safetensors"):
        train(wider, out="other", init=first)
    with pytest.raises(TypeError):
        train(second, out="other", init=7)
    assert not os.path.exists("other")


@pytest.mark.parametrize("out", [None, "run"])
def test_a_callback_sees_every_generation_and_may_stop(config, out):
    seen = []

    def stop_at_three(generation):
        seen.append((generation.generation, generation.last, generation.best_g, generation.mean_g, generation.champion_g))
        return generation.generation == 3

    config = config.replace(stages=[{"from": number, "set": {"world.coupling": 2}} for number in (1, 6)])
    run = train(config, out=out, callback=stop_at_three)
    assert [row[:2] for row in seen] == [(generation, 6) for generation in range(4)]
    for number, _, best, mean, champion in seen:
        assert np.array_equal(best, run.metrics["best_g"][:, number])
        assert np.array_equal(mean, run.metrics["mean_g"][:, number])
        assert np.array_equal(champion, run.metrics["champion_g"][:, number])
    last = run.config["learning.generations"]
    assert 3 <= last <= 5
    config = config.replace(stages=config.to_dict()["stages"][:1])
    assert run.digest == train(config.replace(learning={"generations": last})).digest
    if out is not None:
        assert train(config, out=out, resume=True).digest == train(config).digest


@pytest.mark.parametrize("out", [None, "run"])
def test_a_callback_s_error_comes_through(config, out):
    def fail(generation):
        if generation.generation == 2:
            raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        train(config, out=out, callback=fail)
    with pytest.raises(TypeError, match="the callback gave go on, allowed are True to stop"):
        train(config, callback=lambda generation: "go on")
    if out is not None:
        assert train(config, out=out, resume=True).digest == train(config).digest


def test_a_callback_costs_less_than_a_fiftieth():
    """Of a run of 50 teams: what calls take is told by a tiny world's many generations, where it would be seen."""

    def least(config, callback=None):
        took = []
        for _ in range(5):
            start = time.process_time()
            train(config, backend="cpu", callback=callback, progress=False)
            took.append(time.process_time() - start)
        return min(took)

    paper = Config.paper()
    place = {"leaders": [[5, 5]], "followers": [], "pois": [[9, 9]], "coupling": 1, "steps": 1}
    tiny = paper.replace(world=place, learning={"population": 2, "generations": 3000})
    call = (least(tiny, lambda generation: None) - least(tiny)) / 3001
    assert call < 0.02 * least(paper) / 101


@pytest.mark.skipif(os.name == "nt", reason="signals are another thing there")
def test_ctrl_c_saves_everything(config, tmp_path):
    long = config.replace(learning={"generations": 100_000, "population": 50})
    (tmp_path / "config.toml").write_text(long.to_toml())
    script = (
        "import flotilla\n"
        "config = flotilla.Config.load('config.toml')\n"
        "try:\n"
        "    flotilla.train(config, out='run', backend='cpu')\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as running:
        while not os.path.exists("run/metrics.csv") or os.path.getsize("run/metrics.csv") < 5000:
            assert running.poll() is None
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        assert running.communicate(timeout=60)[0] == "interrupted\n"
    told = json.loads((tmp_path / "run/run.json").read_text())
    assert told["state"] == "stopped" and os.listdir("run/checkpoints")
    reached = told["generations"]
    with pytest.raises(flotilla.Error, match="run"):
        Run.open("run")
    short = []

    def soon(generation):
        short.append(generation.generation)
        return True

    run = train(long, out="run", resume=True, callback=soon)
    assert short[0] >= reached - 1 > 10
    assert run.digest == train(run.config, backend="cpu").digest


def test_two_threads_train_at_once(config):
    runs, configs = {}, [config.replace(learning={"seed": seed}) for seed in range(4)]
    threads = [threading.Thread(target=lambda own=own: runs.update({own["learning.seed"]: train(own)})) for own in configs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for own in configs:
        assert runs[own["learning.seed"]].digest == train(own).digest


def test_other_threads_run_meanwhile(config):
    """The interpreter is free while teams are trained."""
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    thread.start()
    start = time.perf_counter()
    train(config.replace(learning={"generations": 400, "population": 50}), backend="cpu")
    took = time.perf_counter() - start
    done.set()
    thread.join()
    assert took > 0.05 and len(ticks) > took / 0.05


def test_what_is_no_run_is_told(tmp_path):
    with pytest.raises(flotilla.Error, match="nowhere: no such folder"):
        Run.open("nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(flotilla.Error, match="it has no config.toml"):
        Run.open("empty")
    with pytest.raises(TypeError, match="config is str"):
        train("chaotic.toml")
    with pytest.raises(ValueError, match="no-such-gpu|adapter"):
        train(Config.paper(), backend="no-such-gpu")


def test_metrics_as_a_table(config):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    run = train(config, out="run")
    table, file = run.to_pandas(), pandas.read_csv("run/metrics.csv")
    pandas.testing.assert_frame_equal(table, file.drop(columns="seconds"), check_dtype=False)


def test_a_bar_is_drawn(config, monkeypatch):
    auto = pytest.importorskip("tqdm.auto", reason="tqdm is not installed")
    bars = []

    class Bar(auto.tqdm):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            bars.append(self)

    monkeypatch.setattr(auto, "tqdm", Bar)
    seen = []
    train(config, progress=True, callback=lambda generation: seen.append(generation.generation))
    assert [(bar.n, bar.total) for bar in bars] == [(7, 7)] and seen == list(range(7))
    train(config, progress=False)
    assert len(bars) == 1


def test_results_cannot_be_changed_by_accident(config, tmp_path):
    run = pickle.loads(pickle.dumps(flotilla.train(config)))
    for array in (run.policies[0], run.metrics["best_g"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    run.policies[0] = np.zeros_like(run.policies[0])
    run.metrics["best_g"] = np.ones_like(run.metrics["best_g"])
    run.save(tmp_path / "run")
    assert flotilla.Run.open(tmp_path / "run").digest == run.digest


def test_the_recorded_command_is_one_that_a_shell_reads(tmp_path):
    script = tmp_path / "my script.py"
    script.write_text(
        "import flotilla\n"
        "config = flotilla.Config.paper().replace(learning={'generations': 0, 'trials': 1})\n"
        "flotilla.train(config, out='kept', backend='cpu')\n"
    )
    words = [str(script), "it's", "$HOME; ls"]
    subprocess.run([sys.executable, *words], check=True, cwd=tmp_path)
    command = json.loads((tmp_path / "kept/run.json").read_text())["command"]
    assert shlex.split(command)[1:] == words
