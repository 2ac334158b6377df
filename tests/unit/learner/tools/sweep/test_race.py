"""A race: its rungs, who goes on, its file and its page."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made import POLE, pole, stats

from farm.errors import ConfigError
from learner.commands.options import parse
from learner.commands.run import RunCommand
from learner.run import config as configs
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.tools.sweep import race, result
from learner.tools.sweep import tune_command as command
from learner.tools.sweep.portfolio import General, portfolio
from learner.tools.sweep.race import Entry, Race, kept, schedule


def entry(name, policy="linear", sigma=0.1):
    return Entry(name, configure(policy=policy, algorithm="ars", initial_sigma=sigma), 10)


def raced(path, *entries, rollouts=800, scores=()):
    return Race(path, entries, rollouts, list(scores))


# ---------------------------------------------------------------- rungs


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 13])
def test_every_rung_halves_the_entries_and_all_take_the_promised_rollouts(count):
    rungs = schedule(count, 10_000)
    assert rungs[0].entries == count
    assert rungs[-1].entries == 1
    for before, after in zip(rungs, rungs[1:], strict=False):
        assert after.entries == -(-before.entries // 2)
        assert after.rollouts > before.rollouts
    each = np.diff([0, *(rung.rollouts for rung in rungs)])
    spent = sum(rung.entries * more for rung, more in zip(rungs, each, strict=True))
    assert 10_000 - sum(rung.entries for rung in rungs) <= spent <= 10_000
    assert count == 1 or each[-1] >= 4_990, "half of all are the winner's"


def test_the_better_half_goes_on_and_a_place_in_two_is_for_other_kinds_of_policies():
    a = entry("a")
    b = entry("b")
    c = entry("c", "constant")
    d = entry("d", "constant")
    e = entry("e", "mlp")
    prospects = {"a": 3.0, "b": 2.0, "c": 1.0, "d": 0.0, "e": -np.inf}
    assert kept([a, b, c, d], prospects, 2) == [a, c], "the second linear policy makes room"
    assert kept([a, b, c, d, e], prospects, 4) == [a, b, c, d], "the network has diverged"
    assert kept([a, b, c, d, e], {**prospects, "e": -9.0}, 4) == [a, b, c, e]
    assert kept([a, b, c, d, e], {**prospects, "e": -9.0}, 3) == [a, c, e]
    assert kept([a, b, c, d], prospects, 1) == [a]
    assert kept([a, b], prospects, 2) == [a, b], "no other kind is there"
    assert kept([d, c], {"c": 1.0, "d": 1.0}, 1) == [d], "equal ones keep their order"


def test_the_winner_ends_with_the_average_of_its_last_tenth(tmp_path):
    a, b = entry("a"), entry("b", "constant")
    scores = [{"a": 1.0, "b": 0.0}]
    first, last = (raced(tmp_path, a, b, scores=scores[:done]).runs(done) for done in (0, 1))
    assert [config.average for config in first.values()] == [1, 1]
    [config] = last.values()
    assert (config.generations, config.average) == (60, 6)
    assert not list(configs.other(first[tmp_path / "a-s0"], config)), "its run is resumed"
    smooth = replace(a, config=replace(a.config, average=9))
    [config] = raced(tmp_path, smooth, b, scores=scores).runs(1).values()
    assert config.average == 9


def test_an_entry_that_still_gains_may_go_on_before_a_better_one_that_does_not(tmp_path):
    a, b, c, d = entry("a"), entry("b", "mlp"), entry("c", "constant"), entry("d", "constant", 0.2)
    scores = [{"a": -10.0, "b": -60.0, "c": -70.0, "d": None}, {"a": -9.0, "b": -50.0}]
    flat = raced(tmp_path, a, b, c, d, scores=scores)
    assert flat.winner is a
    scores[1]["b"] = -30.0
    assert raced(tmp_path, a, b, c, d, scores=scores).winner is b
    for score in (None, float("nan")):
        scores[1]["b"] = score
        assert raced(tmp_path, a, b, c, d, scores=scores).winner is a, (
            "what has diverged gains nothing"
        )


def test_who_runs_follows_from_the_scores_alone(tmp_path):
    a, b, c, d = entry("a"), entry("b"), entry("c", "constant"), entry("d", "constant", 0.2)
    scores = [{"a": 1.0, "b": 4.0, "c": 3.0, "d": 2.0}, {"b": 1.0, "c": 5.0}, {"c": 6.0}]
    assert raced(tmp_path, a, b, c, d).running(0) == [a, b, c, d]
    assert raced(tmp_path, a, b, c, d, scores=scores[:1]).running(1) == [b, c]
    done = raced(tmp_path, a, b, c, d, scores=scores)
    assert done.winner is c
    assert done.standing == [c, b, d, a]
    last = done.runs(2)
    assert [path.name for path in last] == ["c-s0"]
    assert [config.generations for config in last.values()] == [-(-done.rungs[2].rollouts // 10)]
    assert result.heads(done) == ["entry", "50", "150", "550"]
    assert result.rows(done) == [
        ["c", "3", "5", "6"],
        ["b", "4", "1", "dropped"],
        ["d", "2", "dropped", ""],
        ["a", "1", "dropped", ""],
    ]


# ---------------------------------------------------------------- its file


def test_a_race_continues_in_its_folder_and_in_no_other(tmp_path):
    a, b = entry("a"), entry("b", "constant")
    raced(tmp_path / "r", a, b).prepare()
    contents = json.loads((tmp_path / "r/race.json").read_text())
    (tmp_path / "r/race.json").write_text(
        json.dumps({**contents, "scores": [{"a": 1.0, "b": 2.0}]})
    )
    again = raced(tmp_path / "r", a, b)
    again.prepare()
    assert again.scores == [{"a": 1.0, "b": 2.0}]
    assert again.winner is b
    for other, why in (
        (
            raced(tmp_path / "r", a, b, rollouts=900),
            "was started with --rollouts 800; here it is 900",
        ),
        (raced(tmp_path / "r", a), "has the entries a, b"),
        (raced(tmp_path / "r", a, entry("b", sigma=0.3)), "different settings of b"),
    ):
        with pytest.raises(ConfigError, match=why):
            other.prepare()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds something else"):
        raced(tmp_path / "other", a).prepare()


@pytest.mark.parametrize(
    "text", ["", "[]", '{"version": 2}', '{"version": 1, "rollouts": "8", "entries": {}}']
)
def test_a_damaged_file_is_one_line(tmp_path, text):
    (tmp_path / "race.json").write_text(text)
    with pytest.raises(ConfigError, match=r"race\.json") as error:
        raced(tmp_path, entry("a")).prepare()
    assert "\n" not in str(error.value)


def test_races_that_cannot_be_run(tmp_path):
    a = entry("a")
    with pytest.raises(ConfigError, match="expected 1 to 256"):
        race.check(raced(tmp_path))
    with pytest.raises(ConfigError, match="rollouts is 100000001; expected at most"):
        race.check(raced(tmp_path, a, rollouts=100_000_001))
    with pytest.raises(ConfigError, match="a and b are the same settings"):
        race.check(raced(tmp_path, a, replace(a, name="b")))
    with pytest.raises(
        ConfigError, match=r"79 rollouts are .* give --rollouts \d+ or more"
    ) as error:
        race.check(raced(tmp_path, a, entry("b", sigma=0.2), rollouts=79))
    enough = int(str(error.value).split("--rollouts ")[1].split()[0])
    race.check(raced(tmp_path, a, entry("b", sigma=0.2), rollouts=enough))


@pytest.mark.parametrize("count", [1, 2, 3, 5])
@pytest.mark.parametrize("rollouts", [0, 1, 5])
def test_the_least_rollouts_that_a_message_names_are_enough(tmp_path, count, rollouts):
    entries = [entry(str(i), sigma=0.1 * (1 + i)) for i in range(count)]
    with pytest.raises(ConfigError, match=r"give --rollouts \d+ or more") as error:
        race.check(raced(tmp_path, *entries, rollouts=rollouts))
    enough = int(str(error.value).split("--rollouts ")[1].split()[0])
    race.check(raced(tmp_path, *entries, rollouts=enough))
    with pytest.raises(ConfigError, match=f"give --rollouts {enough} or more"):
        race.check(raced(tmp_path, *entries, rollouts=enough - 1))


# ---------------------------------------------------------------- portfolios and flags


def test_the_flags_of_every_entry_give_its_settings(tmp_path):
    file = pole(tmp_path)
    base = replace(RunConfig(task=f"{file}:Pole"), seed=3)
    entries = race.entries_of(base, portfolio("general"))
    assert [each.name for each in entries] == list(General.entries)
    for each in entries:
        config = replace(each.config, generations=7)
        assert parse(RunCommand, configs.flags(config), "farm run")[0].run == config, each.name
        assert (
            each.generations(1001) * each.per_generation
            >= 1001
            > (each.generations(1001) - 1) * each.per_generation
        )


def test_flags_of_presets_and_lists():
    for config in (
        configure(),
        configure(preset="thesis", seed=4),
        configure(policy="mlp", layers=(8, 4), algorithm="cma-es"),
        configure("fragile-bar", stop_when_solved=5),
    ):
        assert parse(RunCommand, configs.flags(config), "farm run")[0].run == config


def test_entries_that_do_not_fit_are_named(tmp_path):
    base = RunConfig(task=f"{pole(tmp_path)}:Pole")
    for settings, why in (
        ({"policy": "nothing"}, "entry x: unknown policy 'nothing'"),
        ({"algorithm": "ars", "momentum": 0.5}, "entry x: unknown setting momentum"),
        ({"algorithm": "ars", "pairs": 0}, "entry x: .*pairs is 0"),
    ):
        with pytest.raises(ConfigError, match=why):
            race.entries_of(base, {"x": settings})
    with pytest.raises(ConfigError, match="run"):
        race.entries_of(base, {"a/b": {}})
    assert [
        each.name for each in race.entries_of(base, {"x": {}, "y": {"policy": base.policy}})
    ] == ["x"]


def test_a_portfolio_in_a_file(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "class Mine:\n    entries = {'a': {'policy': 'linear'}}\nclass Bad:\n    entries = ['a']\n"
    )
    assert portfolio(f"{file}:Mine") == {"a": {"policy": "linear"}}
    with pytest.raises(ConfigError, match="expected tables of settings by name"):
        portfolio(f"{file}:Bad")
    with pytest.raises(ConfigError, match="unknown portfolio"):
        portfolio("all")


# ---------------------------------------------------------------- the command


def test_the_list_has_the_flags_of_each_entry(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pole(tmp_path)
    words = [
        "pole.py:Pole",
        "--list",
        "--only",
        "linear-es",
        "--entry",
        "policy=mlp,algorithm=es,pairs=7,bias=false",
    ]
    with pytest.raises(ConfigError, match="entry policy=mlp,algorithm=es,pairs=7,bias=false: "):
        command.main(words)
    assert command.main([*words[:-1], "policy=mlp,algorithm=es,pairs=7,normalise=false"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [
        ["linear-es", "40"],
        ["policy-mlp-algorithm-es-pairs-7-normalise-false", "14"],
    ]
    assert "--policy mlp --algorithm es --no-normalise --pairs 7" in lines[2]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "farm tune needs --rollouts or --minutes"),
        (["--rollouts", "900", "--minutes", "1"], "exclude each other"),
        (["--minutes", "1", "--connect", "tcp/learner.lab:7447"], "give --rollouts"),
        (["--rollouts", "50"], "give --rollouts"),
        (["--rollouts", "9000", "--only", "none"], "--only none: no such entry"),
        (["--rollouts", "9000", "--entry", "pairs"], "not of the form NAME=VALUE"),
        (["--rollouts", "9000", "--pairs", "40"], "--pairs is a setting of one algorithm"),
        (["--rollouts", "9000", "--generations", "40"], "--generations follows from --rollouts"),
        (["--rollouts", "9000", "--portfolio", "none"], "unknown portfolio"),
        (["--rollouts", "9000", "--task", "other.py:Pole"], "--task: the task is pole.py:Pole "),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, words, why):
    monkeypatch.chdir(tmp_path)
    pole(tmp_path)
    with pytest.raises(ConfigError, match=why) as error:
        command.main(["pole.py:Pole", *words])
    assert "\n" not in str(error.value)
    assert not (tmp_path / "tunes").exists()


def test_minutes_become_rollouts_once(tmp_path, monkeypatch):
    base = RunConfig(task=f"{pole(tmp_path, POLE)}:Pole")
    entries = race.entries_of(base, {"a": {}})
    few, many = race.affordable(entries, 1.0, 1), race.affordable(entries, 100.0, 1)
    assert 0 < few < many


def test_the_page_has_the_table_the_command_and_the_winner(tmp_path):
    a, b = entry("a"), entry("b", "constant")
    done = raced(tmp_path, a, b, scores=[{"a": -1.0, "b": None}, {"a": -0.5}])
    folder = RunFolder.create(done.folder(a), a.config)
    for g in range(1, 4):
        folder.append(stats(g, mean_policy_return=-float(g)), np.zeros(2), np.ones(2), 3)
    page = result.page(done, figure=True)
    assert "| a | -1 | -0.5 |" in page
    assert "| b | diverged | dropped |" in page
    assert "mean policy\nreturned -1." in page
    assert "farm run --policy linear --algorithm ars" in page
    assert "(figure.svg)" in page
    curves = result.curves(done)
    assert [curve.label for curve in curves] == ["a", "b"]
    assert curves[0].returns.tolist() == [[-1.0, -2.0, -3.0]]


def test_a_mean_policy_that_fails_is_shown_without_a_return(tmp_path):
    a = entry("a")
    one = raced(tmp_path, a)
    with command.Standing(one) as display:
        display.rung(0)
        display.progress(one.folder(a).name, 1, 2, None)
