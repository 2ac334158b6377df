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
    xml = '''<mujoco><worldbody><body><joint name="x" type="slide"/>
        <geom size="1"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>'''
    steps = 5

    def reward(self, sim, action):
        return sim.qpos[:, 0] + %s
"""


@pytest.fixture
def judgement(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[object, float]:
    """What a judge says of a job, and the job's return in this process."""
    file = tmp_path / "slide.py"
    file.write_text(SLIDE % request.param)
    slide = problem(RunConfig(task=f"{file}:Slide", policy="constant"))
    job, mu = Jobs.mean("none", [(1, 2, 3, 4)]), np.full(1, 0.5)
    judge, runner = LocalJudge(slide), slide.runner()
    try:
        return judge(fingerprint.digest(), mu, job, NOT_NORMALISED), runner.run(mu, job).returns[0]
    finally:
        judge.close()
        runner.close()


@pytest.mark.parametrize("judgement", ["0.0"], indirect=True)
def test_it_says_what_a_rollout_returns(judgement) -> None:
    answer, returned = judgement
    assert answer.returns.tolist() == [returned]


def test_its_answer_has_the_terms_that_the_hosts_send(tmp_path: Path) -> None:
    (tmp_path / "slide.py").write_text(SLIDE % "0.0")
    slide = problem(RunConfig(task=f"{tmp_path / 'slide.py'}:Slide", policy="constant"))
    job = Jobs.mean("none", [None])
    mu = np.full(1, 0.5)
    runner = slide.runner()
    judge = LocalJudge(slide)
    answer = judge(fingerprint.digest(), mu, job, NOT_NORMALISED, terms=True)
    results = runner.run(mu, job, "none", NOT_NORMALISED, terms=True)
    assert answer is not None
    assert bits(answer, slice(None)) == bits(results, slice(None))
    assert answer.terms.shape == (1, 1)


@pytest.mark.parametrize("judgement", ["np.random.rand()"], indirect=True)
def test_a_task_that_is_not_deterministic_condemns_nobody(
    judgement, caplog: pytest.LogCaptureFixture
) -> None:
    assert judgement[0] is None
    assert [r.getMessage() for r in caplog.get_records("setup")] == [
        "the same rollout has other numbers when it is repeated: farm check TASK shows where"
    ]
