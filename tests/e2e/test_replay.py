"""`farm replay`: policies and exploring rollouts of finished runs again, with all their numbers,
and with changes.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from finished import GENERATIONS, Say, again, folder, stored
from processes import Farm
from recordings import read, texts

from farm.__main__ import main
from farm.errors import ConfigError
from farm.tasks.finger_gait import model
from learner.tools.replay.loaded import load

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("grips_found_once")]


@pytest.mark.parametrize("name", ["a", "b"])
def test_the_last_policy_gives_the_runs_own_return(done: Farm, name: str) -> None:
    assert again(done, name).trajectory.value == done.summary(name)["mean_policy_return"]


def test_earlier_policies_give_what_their_generation_said(done: Farm) -> None:
    # A line of progress.jsonl has the return of the mean that was explored around: that of the
    # generation before.
    for line in done.progress("a"):
        replay = again(done, generation=line["generation"] - 1)
        assert replay.trajectory.value == line["mean_policy_return"]
        assert replay.trajectory.success == line["mean_policy_success"]


def test_friction_changes_the_rollout_and_a_factor_of_one_does_not(done: Farm) -> None:
    nominal = again(done)
    assert again(done, friction=1.0).trajectory.value == nominal.trajectory.value
    assert again(done, friction=0.05).trajectory.value != nominal.trajectory.value


def test_another_object(done: Farm, tmp_path: Path) -> None:
    text = (model.folder() / "objects/bar.xml").read_text()
    (tmp_path / "thick.xml").write_text(
        text.replace('size="0.011 0.06 0.011"', 'size="0.015 0.045 0.015"')
    )
    (tmp_path / "cannonball.xml").write_text(text.replace('mass="0.05"', 'mass="50"'))
    replay = again(done, object=str(tmp_path / "thick.xml"))
    assert replay.trajectory.value != again(done).trajectory.value
    with pytest.raises(
        ConfigError, match=r"grip 'index\+thumb' does not hold object '.*cannonball.xml'"
    ):
        again(done, object=str(tmp_path / "cannonball.xml"))


def test_a_policy_that_is_not_stored(done: Farm, say: Say, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder(done).path, copy)
    head, _, rows = (copy / "parameters").read_bytes().partition(b"\n")
    size = len(rows) // GENERATIONS
    body = b"".join(rows[g * size : (g + 1) * size] for g in (1, 3))  # of every second generation
    (copy / "parameters").write_bytes(head.replace(b'"every": 1', b'"every": 2') + b"\n" + body)
    output = say("replay", str(copy), "--generation", "3", status=2)
    assert "generation 3 is not stored" in output
    assert "stored are 2 to 4 in steps of 2, the nearest is 2" in output
    assert len(output.splitlines()) == 1
    assert load(copy, 6).generation == 6  # the checkpoint's is always there
    assert np.array_equal(load(copy, 4).mu, stored(done, generation=4).mu)


def test_a_replay_says_what_it_shows(done: Farm, tmp_path: Path) -> None:
    path = tmp_path / "again.rrd"
    done.call("replay", "runs/a", "--generation", "2", "--friction", "0.5", "--to", str(path))
    (text,) = texts(path, "/rollout")
    assert "mean policy after generation 2, friction 0.5" in text


def test_rollouts_side_by_side(done: Farm, say: Say, tmp_path: Path) -> None:
    path = tmp_path / "again.rrd"
    line = done.progress("a")[1]
    output = say(
        "replay", "runs/a", "--generation", "2", "--worst", "2", "--best", "1", "--to", str(path)
    )
    first, second, third, written = output.splitlines()
    assert f"return {line['return_max']:.3f}" in first
    assert f"return {line['return_min']:.3f}" in second
    assert written == f"written to {path}; look at it with: farm view {path}"
    (table,) = texts(path, "/table")
    for text in (first, second, third):
        title, name, result = re.fullmatch(
            r"(generation 2), (rollout \d): (return .*)", text
        ).groups()  # type: ignore[union-attr]
        assert f"### {title} of a" in table
        assert f"| {name} | {result} |" in table
        assert f"/rollouts/{name.replace(' ', chr(92) + ' ')}/world/object" in read(path)
    assert "`farm replay runs/a --generation 2 --rollout I`" in table


def test_one_rollout_and_those_that_the_task_ended(
    done: Farm, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, run = tmp_path / "again.rrd", str(folder(done).path)
    assert main(["replay", run, "--rollout", "3", "--to", str(path)]) == 0
    assert texts(path, "/rollout")[0].startswith(
        f"### rollout 3 of generation {GENERATIONS}\n\nreturn "
    )
    dropped = [line["ended"] for line in done.progress("a")]
    generation = str(1 + int(np.argmax(dropped)))
    status = main(["replay", run, "--generation", generation, "--dropped", "3", "--to", str(path)])
    output = capsys.readouterr()
    assert status == int(not any(dropped))
    assert output.out.count(f"generation {generation}, rollout") == min(3, max(dropped))
    assert (f"no rollout of generation {generation} dropped" in output.err) == (status == 1)


def test_the_recording_offers_the_commands(done: Farm) -> None:
    offered = texts(folder(done).recording, "/again")
    assert len(offered) == GENERATIONS
    assert "farm replay runs/a --generation 1\n" in offered[0]
    assert (
        "farm replay runs/a --generation 1 --best 5\nfarm replay runs/a --generation 1 --worst 5"
        in offered[0]
    )
    for line, text in zip(done.progress("a"), offered, strict=True):
        assert ("--dropped" in text) == bool(line["ended"])
