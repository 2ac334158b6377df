"""Runs of tasks in which some rollouts fail: shown once, counted, with the same numbers for any
number of workers.
"""

import json
import re
from pathlib import Path

import pytest
from processes import Farm

pytestmark = pytest.mark.slow

TASK = '''
import numpy as np
from farm import Task

class Pole(Task):
    """A pole that some rollouts cannot bear."""

    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02"/></body></worldbody>
      <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
    steps, substeps = 30, 5

    def reset(self, sim, row, rng):
        sim.qpos[row] = 0.0 if rng is None else rng.uniform(-0.2, 0.2)

    def reward(self, sim, action):
        if (np.abs(sim.qpos[:, 0]) > MOST).any():
            raise RuntimeError("the solver did not converge")
        return np.cos(sim.qpos[:, 0])
'''


@pytest.fixture
def farm(tmp_path: Path):
    opened = Farm(tmp_path)
    yield opened
    opened.close()


def run(farm: Farm, most: str, name: str, *flags: str, status: int = 0) -> str:
    (farm.folder / "pole.py").write_text(TASK.replace("MOST", most))
    words = ("--task", "pole.py:Pole", "--no-record", "--generations", "6", "--name", name)
    return farm.call("run", *words, *flags, status=status)


def test_errors_of_some_rollouts(farm: Farm) -> None:
    texts = [run(farm, "0.6", f"w{count}", "--workers", str(count)) for count in (1, 3)]
    hashes = [re.findall(r"hash (\w{16})", text) for text in texts]
    assert hashes[0] == hashes[1]
    for text in texts:
        assert (
            text.count(
                "a rollout failed, and counts as such: RuntimeError: the solver did not converge"
            )
            == 1
        )
        assert 'pole.py", line' in text
        assert "in reward" in text
        assert re.search(r"generation 1/6  return +[\d.-]+ \(\d+ failed\)", text)
    lines = [
        (farm.folder / f"runs/w{count}/progress.jsonl").read_text().splitlines() for count in (1, 3)
    ]
    counts = [[json.loads(line)["failed"] for line in each] for each in lines]
    assert counts[0] == counts[1]
    assert sum(counts[0]) > 0
    assert "000000000000.0" not in "".join(lines[0])


def test_strict_ends_at_the_first(farm: Farm) -> None:
    text = run(farm, "0.6", "strict", "--strict", status=1)
    assert "RuntimeError: the solver did not converge" in text.splitlines()[-1]
    assert "in reward" in text


def test_a_run_in_which_all_fail_ends(farm: Farm) -> None:
    text = run(farm, "(-1.0 if sim.t > 3 else 9.0)", "hopeless", status=1)
    assert "all rollouts of 3 generations failed, so that nothing is learnt" in text
    text = farm.call("run", "--resume", "runs/hopeless", "--no-record", status=1)
    assert "all rollouts of 3 generations failed" in text


def test_what_mujoco_warns_of_is_said_once(farm: Farm) -> None:
    balls = "".join(
        f'<body pos="{0.1 * (i % 5)} {0.1 * (i // 5)} 0.1"><freejoint/><geom size=".08"/></body>'
        for i in range(40)
    )
    text = TASK.replace("(np.abs(sim.qpos[:, 0]) > MOST).any()", "False")
    text = text.replace("<mujoco>", '<mujoco><size memory="600K"/>')
    text = text.replace("</worldbody>", f'<geom type="plane" size="1 1 .1"/>{balls}</worldbody>')
    observe = "    def observe(self, sim):\n        return sim.qpos[:, :1]\n\n"
    text = text.replace("    def reward", f"{observe}    def reward", 1)
    (farm.folder / "pile.py").write_text(
        text.replace("sim.qpos[row] = 0.0", "sim.qpos[row, 0] = 0.0")
    )
    words = (
        "--task",
        "pile.py:Pole",
        "--no-record",
        "--generations",
        "2",
        "--pairs",
        "3",
        "--workers",
        "2",
    )
    said = farm.call("run", *words)
    assert said.count("mjWARN_CNSTRFULL") + said.count("mjWARN_CONTACTFULL") >= 1
    assert said.count("mjWARN_CNSTRFULL") <= 1
    assert 'give the model more memory: <size memory="50M"/>' in said
