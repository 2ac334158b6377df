"""The learner's own machine decides between hosts, unless it contradicts itself."""

from pathlib import Path

import numpy as np
import pytest

from farm import fingerprint
from farm.net.work import Jobs
from farm.runner import NOT_NORMALISED
from learner.run.config import RunConfig
from learner.run.judge import LocalJudge
from learner.run.setup import problem
from learner.scheduler.round import bits

SLIDE = """
import numpy as np
from farm import Task

class Slide(Task):
    xml = '''<mujoco><worldbody><body><joint name="x" type="slide"/><geom size="1"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>'''
    steps = 5

    def reward(self, sim, action):
        return sim.qpos[:, 0] + %s
"""


@pytest.fixture
def asked(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[object, float]:
    """What a judge says of a job, and the job's return in this process."""
    file = tmp_path / "slide.py"
    file.write_text(SLIDE % request.param)
    found = problem(RunConfig(task=f"{file}:Slide", policy="constant"))
    job, mu = Jobs.mean("none", [(1, 2, 3, 4)]), np.full(1, 0.5)
    judge, runner = LocalJudge(found), found.runner()
    try:
        return judge(fingerprint.digest(), mu, job, NOT_NORMALISED), runner.run(mu, job).returns[0]
    finally:
        judge.close()
        runner.close()


@pytest.mark.parametrize("asked", ["0.0"], indirect=True)
def test_it_says_what_a_rollout_returns(asked) -> None:
    given, returned = asked
    assert given.returns.tolist() == [returned]


def test_its_answer_has_the_terms_that_the_hosts_send(tmp_path: Path) -> None:
    (tmp_path / "slide.py").write_text(SLIDE % "0.0")
    found = problem(RunConfig(task=f"{tmp_path / 'slide.py'}:Slide", policy="constant"))
    job, mu, runner, judge = Jobs.mean("none", [None]), np.full(1, 0.5), found.runner(), LocalJudge(found)
    given = judge(fingerprint.digest(), mu, job, NOT_NORMALISED, terms=True)
    sent = runner.run(mu, job, "none", NOT_NORMALISED, terms=True)
    assert given is not None
    assert bits(given, slice(None)) == bits(sent, slice(None))
    assert given.terms.shape == (1, 1)


@pytest.mark.parametrize("asked", ["np.random.rand()"], indirect=True)
def test_a_task_that_is_not_deterministic_condemns_nobody(asked, caplog: pytest.LogCaptureFixture) -> None:
    assert asked[0] is None
    assert [r.getMessage() for r in caplog.get_records("setup")] == [
        "the same rollout has other numbers when it is repeated: farm check TASK shows where"
    ]
