"""Tests replays and pictures of runs, and that temporary runs are deleted."""

import os
from pathlib import Path

import numpy as np
import pytest
from conftest import random_policies

import flotilla
from flotilla import Run, rollout, train


def test_replays_are_shown_and_saved_in_each_format(config):
    for run in (train(config), train(config, out="run")):
        replay = run.replay(trial=1, compare=0, team="best")
        assert [(episode.trial, episode.generation) for episode in replay.episodes] == [(1, 0), (1, 6)]
        assert [episode.best_g for episode in replay.episodes] == [run.metrics["best_g"][1, g] for g in (0, 6)]
        assert replay._repr_html_().startswith("<iframe srcdoc=") and "<script" in replay.page()
        magic = {"html": b"<!", "gif": b"GIF89a", "svg": b"<svg", "pdf": b"%PDF", "png": b"\x89PNG"}
        for extension, start in magic.items():
            replay.save(f"team.{extension}", width=200 if extension in ("gif", "png") else None)
            with open(f"team.{extension}", "rb") as file:
                assert file.read(200).lstrip().startswith(start), extension
        assert replay.still(0).svg() != replay.still().svg()
        with pytest.raises(ValueError, match="its name must end in .html"):
            replay.save("team.txt")
        with pytest.raises(ValueError, match="step 26"):
            replay.still(26)
    for wrong in ({"trial": 2}, {"generation": 7}, {"trial": -1}, {"trial": "first"}, {"team": 20}, {"team": "mean"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            run.replay(**wrong)


def test_replays_show_any_team_and_trial(config):
    run = train(config)
    champions = run.metrics["champion_g"][:, -1]
    for trial, g in (("best", champions.max()), ("worst", champions.min()), (1, champions[1])):
        champion = run.replay(trial=trial, team="champion").episodes[0]
        assert champion.best_g == g and champion.team is None and champion.generation == 6
    assert run.replay(trial="best").episodes[0].best_g == run.metrics["best_g"][:, -1].max()
    replay = run.replay(team=3, generation=0)
    assert replay.episodes[0].team == 3 and repr(replay).startswith("<flotilla.Replay: team 3 of trial 0 generation 0 (G ")


def test_policies_from_anywhere_are_replayed(config):
    policies = random_policies(config, 30)
    scores = rollout(config, policies)
    best = np.argsort(-scores.g)[:2]
    replay = flotilla.replay(config, policies, best)
    assert [(episode.team, episode.best_g) for episode in replay.episodes] == [(team, scores.g[team]) for team in best]
    assert replay.episodes[0].trial is None and replay.episodes[0].generation is None
    page = replay.page()
    assert '"given":true' in page and f"Team number {best[0]}" in page
    assert "generation" not in replay.still().svg().lower() and "given policies" in replay.still().svg()
    replay.save("found.gif", width=100, fps=2)
    drawn = {"episodes": 1, "seed": 4, "jitter": 2.0, "poi_jitter": 3.0}
    moved = flotilla.replay(config, policies[:, 7:8], **drawn)
    assert moved.episodes[0].best_g == rollout(config, policies[:, 7:8], **drawn).g[0]
    assert moved.still().svg() != flotilla.replay(config, policies[:, 7:8]).still().svg()
    shared = random_policies(config, 2, leaders=1)
    assert flotilla.replay(config, shared, 1).episodes[0].best_g == rollout(config, shared).g[1]
    for wrong in (30, -1, [], "best", 0.5):
        with pytest.raises((ValueError, TypeError), match="team"):
            flotilla.replay(config, policies, wrong)
    with pytest.raises(ValueError, match="is NaN"):
        flotilla.replay(config, policies * np.nan)
    with pytest.raises(ValueError, match="pass episodes="):
        flotilla.replay(config, policies, jitter=1.0)


def test_replays_have_the_world_of_their_stage(config):
    pois = [[15.0, 14.0], [35.0, 14.0]]
    stages = [{"from": 3, "set": {"world.steps": 25, "world.pois": pois}}]
    run = train(config.replace(world={"steps": 40}, stages=stages))
    for generation, steps in ((2, 40), (3, 25)):
        replay = run.replay(generation=generation)
        assert f"step {steps} of {steps}: " in replay.still().svg()
        with pytest.raises(ValueError, match=f"the episode has steps 0 to {steps}"):
            replay.still(steps + 1)
        page = replay.page()
        assert f'"steps":{steps}' in page and ('"pois":[[15.0,14.0],[35.0,14.0]]' in page) == (generation == 3)
        replay.save("team.gif", width=100, fps=2)
    assert len(run.replay(generation=6, compare=3).episodes) == 2


def test_generations_with_different_worlds_are_not_shown_side_by_side(config):
    run = train(config.replace(stages=[{"from": 3, "set": {"world.coupling": 2}}]))
    with pytest.raises(ValueError, match="generations 2 and 3 are of different stages"):
        run.replay(generation=3, compare=2)
    moved = train(config.replace(learning={"poi_jitter": 0.5}))
    with pytest.raises(ValueError, match="POIs are elsewhere in every generation"):
        moved.replay(compare=0)
    assert len(moved.replay().episodes) == 1


def test_curves_are_drawn(config):
    runs = [train(config), train(config.replace(learning={"fitness": "G"}))]
    assert runs[0].plot()._repr_svg_() != flotilla.plot(runs).svg()
    runs[1].save("kept")
    assert flotilla.plot([runs[0], "kept"]).svg()[:4] == "<svg"
    assert flotilla.plot("kept").svg() == flotilla.plot(runs[1]).svg() == flotilla.plot([Path("kept")]).svg()
    assert "G of the champion" in flotilla.plot(runs, measure="champion").svg() != flotilla.plot(runs, measure="best").svg()
    assert runs[0].plot("mean").svg() != runs[0].plot("best").svg()
    with pytest.raises(ValueError, match='measure "worst": allowed champion, best, mean or test'):
        flotilla.plot(runs, measure="worst")
    flotilla.plot(runs).save("curves.png", width=400)
    assert os.path.getsize("curves.png") > 1000
    with pytest.raises(ValueError, match="0 runs"):
        flotilla.plot([])


def test_a_run_without_out_is_deleted_with_its_object(config):
    run = train(config)
    folder = run.folder
    assert Run.open(folder).digest == run.digest
    del run
    assert not os.path.exists(folder)
