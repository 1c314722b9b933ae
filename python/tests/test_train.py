"""Tests `train` and `Run`: the same bits and files as the program, resuming, callbacks, interrupts and threads."""

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

def assert_same_as_the_program(config, program, tmp_path):
    """Trains with the program, without a directory, and with one, and compares digests, policies and metrics."""
    (tmp_path / "config.toml").write_text(config.to_toml())
    program("train", "config.toml", "--out", "theirs", "--backend", "cpu", "--quiet")
    theirs = Run.open("theirs")
    ours = train(config, backend="cpu", progress=False)
    ours.save("saved")
    with_out = train(config, out="out", backend="cpu")
    digest = json.loads((tmp_path / "theirs/run.json").read_text())["digest"]
    assert {ours.digest, with_out.digest, theirs.digest, Run.open("saved").digest} == {digest}
    for folder in ("saved", "out"):
        assert filecmp.cmp("theirs/policies.safetensors", f"{folder}/policies.safetensors", shallow=False)
        assert filecmp.cmp("theirs/config.toml", f"{folder}/config.toml", shallow=False)
    for our_policies, their_policies in zip(ours.policies, theirs.policies):
        assert np.array_equal(our_policies.view(np.uint32), their_policies.view(np.uint32))
    for name, values in ours.metrics.items():
        assert np.array_equal(values, theirs.metrics[name])
    assert ours.config == theirs.config == config


@pytest.mark.parametrize("paradigm", ["leader-follower", "all-leaders"])
@pytest.mark.parametrize("layout", ["generally_forward", "strictly_forward", "chaotic"])
def test_the_paper_s_configs_give_the_program_s_results(layout, paradigm, program, tmp_path):
    config = Config.paper(layout, paradigm=paradigm).replace(learning={"generations": 4, "trials": 2})
    assert_same_as_the_program(config, program, tmp_path)


@pytest.mark.parametrize("seed", range(6))
def test_random_configs_give_the_program_s_results(seed, program, tmp_path):
    assert_same_as_the_program(random_config(seed), program, tmp_path)


def test_metrics_and_policies_have_the_documented_shapes(config):
    run = train(config, seed=3)
    assert run.config["learning.seed"] == 3
    for name in ("best_g", "mean_g", "champion_g"):
        assert run.metrics[name].shape == (2, 7) and run.metrics[name].dtype == np.float64
    assert [trial.shape for trial in run.policies] == [(4, 20, 112)] * 2
    with pytest.raises(KeyError, match="g: no such metric; there are best_g, mean_g, champion_g"):
        pickle.loads(pickle.dumps(run)).metrics["g"]
    assert run.policies[0].dtype == np.float32 and run.policies[0].flags.c_contiguous
    assert run.digest != train(config, seed=4).digest
    unpickled = pickle.loads(pickle.dumps(run))
    assert unpickled.digest == run.digest and unpickled.config == run.config
    assert repr(run).startswith("<flotilla.Run: 2 trials, 6 generations, champion's G ")
    short = train(config.replace(learning={"trials": 1, "generations": 1}))
    assert repr(short).startswith("<flotilla.Run: 1 trial, 1 generation, champion's G ")


def test_the_program_resumes_runs_of_the_package(config, program):
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
    """Returns the content of a run's files by name, without names, times, paths, and the program that wrote them."""

    def content(path):
        data = path.read_bytes()
        if path.name == "metrics.csv":
            return [line.rsplit(b",", 1)[0] for line in data.splitlines()]
        if path.name == "run.json":
            excluded = ("name", "started", "updated", "seconds", "command", "commit")
            return {key: value for key, value in json.loads(data).items() if key not in excluded}
        if path.parent.name == "checkpoints":
            length = int.from_bytes(data[:8], "little")
            header = json.loads(data[8 : 8 + length])
            for key in ("seconds", "metrics_bytes", "metrics_sha256", "sha256"):
                header["__metadata__"].pop(key, None)
            return header, data[8 + length :]
        return data

    return {str(path.relative_to(folder)): content(path) for path in pathlib.Path(folder).rglob("*") if path.is_file()}


@pytest.mark.parametrize("method", ["tournament", "openai-es"])
def test_all_ways_to_train_write_the_same_files(config, program, tmp_path, method):
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
        files = files_of(folder)
        assert files.keys() == expected.keys(), folder
        for name, content in expected.items():
            assert files[name] == content, (folder, name)
    for folder in ("theirs", *copies):
        arguments = ("--resume", "--generations", "16", "--json", "--backend", "cpu")
        extended = json.loads(program("train", f"{folder}/config.toml", "--out", folder, *arguments))
        # Only the ten new generations are trained.
        assert (extended["digest"], extended["trained_generations"]) == (longer, 10), folder


def test_saved_runs_have_the_time_when_training_started(config):
    run, told = train(config), flotilla.Coevolution(config)
    told.tell(told.play().fitness)
    # Times are in whole seconds.
    time.sleep(1.1)
    told_later = pickle.loads(pickle.dumps(told))
    for coevolution in (told, told_later):
        while not coevolution.done:
            coevolution.tell(coevolution.play().fitness)
    unpickled = pickle.loads(pickle.dumps(run))
    runs = {"saved": run, "pickled": unpickled, "told": told.run, "told later": told_later.run}
    for folder, each in runs.items():
        each.save(folder)
    Run.open("saved").save("copy")
    records = {name: json.loads(pathlib.Path(name, "run.json").read_text()) for name in (*runs, "copy")}
    for name, record in records.items():
        assert record["started"] < record["updated"], name
    for name, copy in (("saved", "pickled"), ("saved", "copy"), ("told", "told later")):
        assert records[name]["started"] == records[copy]["started"], copy


@pytest.mark.parametrize("out", [None, "run"])
def test_implausible_configs_warn(config, out):
    with pytest.warns(RuntimeWarning, match="degrees"):
        train(config.replace(world={"heading": 90.0}), out=out)
    with pytest.warns(RuntimeWarning, match="cannot be reached"):
        train(config.replace(world={"steps": 2}), out=out, force=out is not None)


def test_an_existing_run_is_resumed_or_overwritten_only_on_request(config):
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


def test_a_failed_picture_does_not_lose_the_run(config):
    os.makedirs("run/curves.svg/full")
    with pytest.raises(flotilla.Error, match="curves.svg"):
        train(config, out="run")
    assert os.listdir("run") == ["curves.svg"]
    # A resumed run only warns about its picture.
    with pytest.warns(RuntimeWarning, match="curves.svg"):
        run = train(config, out="run", resume=True)
    assert Run.open("run").digest == run.digest


def test_a_callback_may_change_the_working_directory(config, tmp_path):
    (tmp_path / "other").mkdir()
    expected = flotilla.train(config, out="reference")
    run = flotilla.train(config, out="run", callback=lambda generation: os.chdir(tmp_path / "other"))
    assert run.digest == expected.digest
    for name in ["config.toml", "curves.svg", "policies.safetensors"]:
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "reference" / name).read_bytes()
    assert os.listdir(tmp_path / "other") == []


def test_init_starts_from_the_policies_of_another_run(config, program):
    first = train(config, out="first")
    second = config.replace(learning={"fitness": "G", "population": 30, "seed": 9})
    warm = train(second, out="warm", init=first)
    arguments = ("--init", "first/policies.safetensors", "--out", "theirs", "--backend", "cpu", "--quiet")
    program("train", "warm/config.toml", *arguments)
    assert warm.digest == Run.open("theirs").digest != train(second).digest
    assert train(second, out="again", init="first/policies.safetensors").digest == warm.digest
    assert train(second, out="from memory", init=train(config)).digest == warm.digest
    # The run stores its generation 0, so it can be resumed and replayed without the initial policies.
    assert train(second, out="warm", resume=True).digest == warm.digest
    assert [episode.generation for episode in warm.replay(compare=0).episodes] == [0, 6]
    # A copy does not contain its initial policies, so it cannot be replayed.
    warm.save("copy")
    assert Run.open("copy").digest == warm.digest
    # It has the times of the original.
    assert filecmp.cmp("copy/metrics.csv", "warm/metrics.csv", shallow=False)
    with pytest.raises(flotilla.Error, match="started from given policies"):
        Run.open("copy").replay(team="best")
    # It has the last checkpoint, so it can be extended without the initial policies.
    longer = second.replace(learning={"generations": 9})
    assert train(longer, out="copy", resume=True).digest == train(longer, init=first).digest
    # Without the checkpoint, it would have to start again from the initial policies.
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
        numbers = generation.generation, generation.last
        seen.append((*numbers, generation.best_g, generation.mean_g, generation.champion_g))
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
    assert run.digest == train(config.replace(learning={"generations": last})).digest
    if out is not None:
        assert train(config, out=out, resume=True).digest == train(config).digest


@pytest.mark.parametrize("out", [None, "run"])
def test_errors_of_callbacks_are_raised(config, out):
    def fail(generation):
        if generation.generation == 2:
            raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        train(config, out=out, callback=fail)
    with pytest.raises(TypeError, match="the callback gave go on, allowed are True to stop"):
        train(config, callback=lambda generation: "go on")
    if out is not None:
        assert train(config, out=out, resume=True).digest == train(config).digest


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_ctrl_c_saves_a_run_that_can_resume(config, tmp_path):
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
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["state"] == "stopped" and os.listdir("run/checkpoints")
    reached = record["generations"]
    with pytest.raises(flotilla.Error, match="run"):
        Run.open("run")
    seen = []

    def stop_at_once(generation):
        seen.append(generation.generation)
        return True

    run = train(long, out="run", resume=True, callback=stop_at_once)
    assert seen[0] >= reached - 1 > 10
    assert run.digest == train(run.config, backend="cpu").digest


def test_threads_can_train_at_the_same_time(config):
    runs, configs = {}, [config.replace(learning={"seed": seed}) for seed in range(4)]

    def run(own):
        runs[own["learning.seed"]] = train(own)

    threads = [threading.Thread(target=run, args=(own,)) for own in configs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for own in configs:
        assert runs[own["learning.seed"]].digest == train(own).digest


def test_training_releases_the_interpreter_lock(config):
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    thread.start()
    start = time.perf_counter()
    train(config.replace(learning={"generations": 400, "population": 50}), backend="cpu")
    seconds = time.perf_counter() - start
    done.set()
    thread.join()
    # With the lock free, the thread ticks almost every millisecond. One tick per 50 ms is enough on a busy machine.
    assert seconds > 0.05 and len(ticks) > seconds / 0.05


def test_missing_runs_and_invalid_arguments_raise(tmp_path):
    with pytest.raises(flotilla.Error, match="nowhere: no such folder"):
        Run.open("nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(flotilla.Error, match="it has no config.toml"):
        Run.open("empty")
    with pytest.raises(TypeError, match="config is str"):
        train("chaotic.toml")
    with pytest.raises(ValueError, match="no-such-gpu|adapter"):
        train(Config.paper(), backend="no-such-gpu")


def test_metrics_convert_to_a_pandas_table(config):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    run = train(config, out="run")
    table, file = run.to_pandas(), pandas.read_csv("run/metrics.csv")
    pandas.testing.assert_frame_equal(table, file.drop(columns="seconds"), check_dtype=False)


def test_progress_uses_a_tqdm_bar(config, monkeypatch):
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


def test_result_arrays_are_read_only_and_save_ignores_replaced_ones(config, tmp_path):
    run = pickle.loads(pickle.dumps(flotilla.train(config)))
    for array in (run.policies[0], run.metrics["best_g"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    run.policies[0] = np.zeros_like(run.policies[0])
    run.metrics["best_g"] = np.ones_like(run.metrics["best_g"])
    run.save(tmp_path / "run")
    assert flotilla.Run.open(tmp_path / "run").digest == run.digest


def test_the_recorded_command_is_quoted_for_a_shell(tmp_path):
    script = tmp_path / "my script.py"
    script.write_text(
        "import flotilla\n"
        "config = flotilla.Config.paper().replace(learning={'generations': 0, 'trials': 1})\n"
        "flotilla.train(config, out='kept', backend='cpu')\n"
    )
    arguments = [str(script), "it's", "$HOME; ls"]
    subprocess.run([sys.executable, *arguments], check=True, cwd=tmp_path)
    command = json.loads((tmp_path / "kept/run.json").read_text())["command"]
    assert shlex.split(command)[1:] == arguments


def test_no_answer_of_one_callback_hides_that_of_another(config):
    def no(generation):
        return generation.champion_g.min() > 2

    def stops(generation):
        return generation.generation == 2

    alone, together = train(config, callback=stops), train(config, callback=[no, stops])
    assert together.digest == alone.digest != train(config, callback=no).digest


def test_a_run_whose_folder_was_overwritten_says_so(config, tmp_path, monkeypatch):
    run = train(config, seed=1, out="run")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert len(run.replay(backend="cpu").episodes) == 1
    monkeypatch.chdir(tmp_path)
    train(config, seed=2, out="run", force=True)
    for use in (run.plot, run.replay, lambda: train(config, init=run)):
        with pytest.raises(flotilla.Error, match="holds another run by now"):
            use()


def test_runs_of_a_generator_are_read_before_they_are_freed(config):
    configs = [config.replace(learning={"fitness": fitness}) for fitness in ("G", "D")]
    assert flotilla.plot(train(each) for each in configs).svg().startswith("<svg")
    assert flotilla.compare(map(train, configs))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_process_keeps_the_folder_of_its_parent(config):
    run = train(config)
    folder = run.folder
    child = os.fork()
    if child == 0:
        del run
        os._exit(0)
    os.waitpid(child, 0)
    assert os.path.isdir(folder) and len(run.replay(backend="cpu").episodes) == 1


def test_saving_a_run_over_itself_keeps_its_checkpoints(config):
    run = train(config, init=train(config), out="own")
    before = sorted(os.listdir("own"))
    run.save("own", force=True)
    assert sorted(os.listdir("own")) == before and len(run.replay(generation=0, backend="cpu").episodes) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux passes any bytes")
def test_arguments_of_the_process_need_not_be_text():
    script = "import flotilla; flotilla.train(flotilla.Config.paper().replace(learning={'generations': 1}), out='run')"
    subprocess.run([sys.executable, "-c", script, b"\xff"], check=True, timeout=300)
    assert "?" in json.loads(pathlib.Path("run/run.json").read_text())["command"]


def test_fewer_initial_policies_than_team_elites(config):
    elites = config.replace(learning={"population": 40, "team_elites": 10})
    policies = np.zeros((config.num_learners, 8, config.parameters), np.float32)
    assert train(elites, init=policies).policies[0].shape[1] == 40
