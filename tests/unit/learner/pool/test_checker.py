"""The checker's process: what it says of answers, and what becomes of it."""

import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from doubles import HEADER

from farm import fingerprint
from farm.net.work import Jobs
from farm.runner_process import Begin
from learner.pool.audit import Check, Finding, Source
from learner.pool.checker import Checker
from learner.pool.round import bits
from learner.run.config import RunConfig
from learner.run.setup import Problem, problem

SLIDE = """
import numpy as np
from farm import Task

class Slide(Task):
    xml = '''<mujoco><worldbody><body><joint name="x" type="slide"/>
        <geom size="1"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>'''
    steps = 5

    def reward(self, sim, action):
        return sim.qpos[:, 0] + %s
"""


MU = np.full(1, 0.5)
Made = Callable[..., Checker]


class Bench:
    """A checker of a small task, and questions to it."""

    def __init__(self, slide: Problem, python: str = "") -> None:
        self.answers = threading.Event()
        self.slide = slide
        self.checker = Checker(self._begin, python, self.answers.set)

    def _begin(self, _: Path) -> Begin:
        files = tuple(map(str, self.slide.files))
        spec = self.slide.specification("r")
        return Begin(spec=spec, files=files, backend="cpu", fingerprint=True)

    def check(self, number: int = 0, *, lie: float = 0.0, digest: str = "") -> Check:
        """A host's answer to a job, which is honest if `lie` is 0."""
        job = Jobs.mean("none", [(1, 2, 3, number)])
        job.table[:, 0] = number
        with closing(self.slide.runner()) as runner:
            results = runner.run(MU, job)
        answer = bits(replace(results, returns=results.returns + lie), slice(None))
        source = Source("a", digest or fingerprint.digest())
        return Check(source, replace(HEADER, mu=MU), job, answer)

    def found(self, *checks: Check) -> list[Finding]:
        self.answers.clear()
        self.checker.give(checks)
        assert self.checker.room == 0
        assert self.answers.wait(60)
        findings = self.checker.findings()
        assert [check for check, _ in findings] == list(checks)
        assert self.checker.room > 0
        return [finding for _, finding in findings]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    with ExitStack() as stack:

        def build(expression: str = "0.0", python: str = "") -> Bench:
            file = tmp_path / "slide.py"
            file.write_text(SLIDE % expression)
            slide = problem(RunConfig(task=f"{file}:Slide", policy="constant"))
            made = Bench(slide, python)
            stack.enter_context(closing(made.checker))
            return made

        yield build


def test_it_tells_wrong_answers_from_right_ones(bench) -> None:
    one = bench()
    assert one.found(one.check(), one.check(1, lie=1e-15), one.check(2)) == [
        "right",
        "wrong",
        "right",
    ]
    assert one.found(one.check(3)) == ["right"]


def test_it_knows_nothing_of_machines_that_round_differently(bench) -> None:
    one = bench()
    assert one.found(one.check(digest="bogus"), one.check(1)) == ["unknown", "right"]
    assert "rounds differently" in one.checker.trouble


def test_a_task_that_is_not_deterministic_condemns_nobody(bench) -> None:
    one = bench("np.random.rand()")
    assert one.found(one.check()) == ["unknown"]
    assert one.checker.trouble == (
        "the same rollout has other numbers when it is repeated: farm check TASK shows where"
    )


@pytest.mark.slow
def test_a_process_that_dies_is_replaced(bench) -> None:
    one = bench()
    assert one.found(one.check()) == ["right"]
    os.kill(one.checker.pid, signal.SIGKILL)
    assert one.found(one.check(1), one.check(2, lie=1.0)) == ["right", "wrong"]


@pytest.mark.slow
def test_whatever_fails_in_it_is_no_finding_and_it_goes_on(bench, monkeypatch) -> None:
    one = bench()
    assert one.found(one.check()) == ["right"]

    def nothing_left(*_: object) -> None:
        raise OSError("no more processes")

    with monkeypatch.context() as patch:
        patch.setattr("farm.subprocess_runner.RunnerProcess", nothing_left)
        os.kill(one.checker.pid, signal.SIGKILL)
        assert one.found(one.check(1), one.check(2)) == ["unknown", "unknown"]
        assert "no more processes" in one.checker.trouble
    assert one.found(one.check(3), one.check(4, lie=1.0)) == ["right", "wrong"]


def test_a_job_that_fails_here_says_nothing_of_the_others(bench) -> None:
    one = bench()
    one.found(one.check())
    check = one.check(1)
    broken = replace(check, job=Jobs(table=check.job.table, eps=np.zeros((1, 3))))
    object.__setattr__(broken.job, "table", np.where(np.arange(10) == 2, 1, broken.job.table))
    assert one.found(broken, check) == ["unknown", "right"]


def test_a_command_says_which_python_checks(bench) -> None:
    one = bench(python=f"env CHECKER=1 {shlex.quote(sys.executable)}")
    assert one.found(one.check()) == ["right"]
    nowhere = bench(python="no-such-python")
    assert nowhere.found(nowhere.check()) == ["unknown"]
    assert nowhere.found(nowhere.check()) == ["unknown"]
    assert "no-such-python" in nowhere.checker.trouble


def test_it_starts_nothing_until_it_is_needed(bench) -> None:
    one = bench()
    assert one.checker.pid is None
    one.checker.close()
    assert one.checker.pid is None


def test_closing_ends_checks_that_are_being_made(bench, monkeypatch) -> None:
    errors = []
    monkeypatch.setattr(threading, "excepthook", errors.append)
    hangs = "(exec('while True: pass') if 'CHECKER' in __import__('os').environ else 0.0)"
    one = bench(hangs, f"env CHECKER=1 {shlex.quote(sys.executable)}")
    one.checker.give([one.check(), one.check(1)])
    one.checker.close()
    assert one.checker.findings() == []
    assert errors == []
