"""The learner's own answer to a job, which decides between hosts whose answers differ."""

import logging

from farm import fingerprint
from farm.arrays import FloatArray
from farm.errors import described
from farm.net.work import Jobs, Simulated
from farm.runner import Runner
from learner.run.setup import Problem
from learner.scheduler.round import bits

log = logging.getLogger(__name__)


class LocalJudge:
    """Simulates single jobs on this machine; the simulation is prepared when it is first needed."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._runner: Runner | None = None

    def __call__(
        self, canary: str, mu: FloatArray, job: Jobs, normaliser: FloatArray, *, terms: bool = False
    ) -> Simulated | None:
        """Results of one job around a mean (P,), as machines with this canary, or one that begins
        so, compute them.

        With `terms` they have each reward term's part of the returns.

        None if this machine rounds differently, or, with a line in the log, if it cannot simulate
        the task or gets other numbers when it does so again.
        """
        if not fingerprint.digest().startswith(canary):
            return None
        try:
            self._runner = self._runner or self._problem.runner()
            first, again = (
                self._runner.run(mu, job, "none", normaliser, terms=terms) for _ in range(2)
            )
        except Exception as error:  # a task may need what only the workers' machines have
            log.warning("the learner's machine cannot repeat this job (%s)", described(error))
            return None
        if bits(first, slice(None)) != bits(again, slice(None)):
            log.warning(
                "the same rollout has other numbers when it is repeated: farm check TASK shows"
                " where"
            )
            return None
        return first

    def close(self) -> None:
        """Release the simulation."""
        if self._runner is not None:
            self._runner.close()
