"""A pool that evaluates parameter vectors, for your own search methods.

import farm

with farm.Farm("finger-gait", policy="kernel", workers=2) as pool:
    returns = pool.map(thetas, seeds=range(len(thetas)))
"""

import logging
import os
import secrets
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import seeds as streams
from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError, RunError
from farm.fingerprint import digest
from farm.link import Link
from farm.net.session import free_endpoint
from farm.net.work import Jobs
from farm.sim.trajectory import Trajectory
from farm.tasks.base import TaskSpec
from learner.pool.admission import Admission
from learner.pool.connection import connected
from learner.pool.placement import Placement, check_workers
from learner.pool.pool import Stopped, open_pool
from learner.pool.round import RoundResults
from learner.pool.scheduler import SchedulerConfig
from learner.run.config import configure
from learner.run.setup import problem

log = logging.getLogger(__name__)

_CHECKS: Final = 10.0  # [s] at least that a call waits for checks, which begin with a process
_GATHER: Final = 256 << 20  # [bytes] of parameters that are distributed at a time


@dataclass(frozen=True)
class Evaluated:
    """Results of B rollouts, in the order of their parameters.

    Example:
      ```python
      import numpy as np

      import farm

      with farm.Farm("finger-gait", policy="constant", workers=1) as pool:
          results = pool.evaluate(np.zeros((2, pool.size)), seeds=[0, 1])
          assert isinstance(results, farm.Evaluated)
          assert results.terms.shape == (2, len(pool.spec.terms))
      ```
    """

    returns: FloatArray
    """(B,)"""
    measures: FloatArray
    """Values of the task's measures, in their order (B, M)"""
    success: BoolArray | None
    """(B,), None if the task does not define success"""
    failed: BoolArray
    """(B,) whether the simulation became unstable"""
    steps: IntArray
    """Control steps, (B,)"""
    terms: FloatArray
    """Each reward term's part of the return, discounted and scaled (B, K): they add up to it, but
    for rounding; zeros if the return was clamped
    """
    traces: AnyArray | None
    """Values of the channels with trace=True, float32, zero after the end (B, T, N); None if they
    were not requested
    """


class Farm:
    """Workers that evaluate parameters of a task's policy: each exactly once, in order, even if
    workers die.

    Several threads can use it in turn. Ctrl-C ends a call; the pool stays usable. It ends with the
    program.

    Example:
      ```python
      import numpy as np

      import farm

      with farm.Farm("finger-gait", policy="constant", workers=2) as pool:
          thetas = np.zeros((4, pool.size))  # (B, P)
          returns = pool.map(thetas, seeds=range(4))  # (B,)
      assert returns.shape == (4,)
      ```
    """

    def __init__(
        self,
        task: str = "finger-gait",
        *,
        workers: int = 2,
        connect: str | Sequence[str] = (),
        farm: str = "farm",
        tls: str | Path | None = None,
        audit: float = 0.02,
        fingerprint: str = "",
        checker: str = "",
        **settings: Any,  # noqa: ANN401  any setting of task and policy
    ) -> None:
        """Start local workers, or use those of a farm.

        Args:
          task: name of the task, or FILE.py:CLASS.
          workers: processes on this machine; none are started with `connect`.
          connect: address of a router that workers are connected to.
          farm: name of the farm.
          tls: folder with a learner's certificates.
          audit: share of the farm's evaluations that a process of this machine repeats as a check.
          fingerprint: of the machines whose numbers count, or how it begins (`farm status` shows
            it); by default this machine's.
          checker: command of the Python that checks, if not this one: of a machine that rounds as
            those do, such as "ssh HOST PYTHON".
          settings: of task and policy as in `farm.configure`, such as policy="linear", preset,
              perturb.

        Raises:
          ConfigError: a setting is invalid.
          FarmError: there is no router at `connect`.
        """
        endpoints = (connect,) if isinstance(connect, str) else connect
        if not isinstance(endpoints, Sequence) or not all(
            isinstance(each, str) for each in endpoints
        ):
            raise ConfigError(
                f"connect is {connect!r}; expected tcp/HOST:PORT or tls/HOST:PORT, or several of"
                " them"
            )
        if not endpoints:
            check_workers(workers)
        link = Link(connect=tuple(endpoints), farm=farm, tls=None if tls is None else Path(tls))
        self._problem = problem(configure(task, **settings))
        self._place = Placement(
            workers=0 if endpoints else workers,
            listen=free_endpoint(),
            connect=link.connect,
            farm=link.farm,
            tls=link.bundle,
            scheduler=SchedulerConfig(audit=audit),
            checker=checker,
        )
        self._closed, self._taken, self._round = threading.Event(), threading.Lock(), 0
        self._holder: int | None = None  # the thread of the current call
        self._process = os.getpid()
        with ExitStack() as stack:
            name = f"pool-{secrets.token_hex(4)}"
            admission = Admission(fingerprint or digest())
            opened = connected(self._problem, self._place, self._closed.is_set)
            connection = stack.enter_context(opened)
            pool = open_pool(connection, self._problem, name, admission)
            self._pool = stack.enter_context(pool)
            # Also for a program that ends, or drops this object, without closing it.
            self._finish = weakref.finalize(
                self, _finish, stack.pop_all(), self._closed, self._process
            )

    @property
    def size(self) -> int:
        """Length P of a parameter vector."""
        return self._problem.policy.size

    @property
    def spec(self) -> TaskSpec:
        """Specification of the task: names of its measures, terms and channels."""
        return self._problem.spec

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the local workers."""
        return self._pool.worker_pids

    def map(self, thetas: Any, seeds: Iterable[int] | None = None) -> FloatArray:  # noqa: ANN401  what asarray takes
        """Returns of parameters (B, P), in their order, (B,).

        Args:
          thetas: parameters of B rollouts.
          seeds: one for each rollout's start and conditions, whole numbers below 2^32; None:
              nominal conditions.

        Raises:
          ConfigError: thetas or seeds have a wrong shape or value; nothing was sent.
          RunError: an evaluation failed on every worker that tried it, or the pool is closed.
        """
        theta = self._parameters(thetas)
        starts = self._seeds(seeds, len(theta))
        if not len(theta):
            return np.empty(0)
        with self._turn():
            self._begin(Jobs.exploring(theta, (1,), starts))
            return self._collected().returns.copy()

    def evaluate(
        self,
        thetas: Any,  # noqa: ANN401  what asarray takes
        seeds: Iterable[int] | None = None,
        *,
        traces: bool = False,
    ) -> Evaluated:
        """Everything that is known of rollouts of parameters (B, P), in their order; arguments and
        errors as in `map`.

        Args:
          thetas: parameters of B rollouts.
          seeds: one for each rollout's start and conditions; None: nominal conditions.
          traces: whether the channels' traces are wanted as well.

        Raises:
          ConfigError: traces are wanted, but no channel of the task has trace=True.
        """
        theta, spec = self._parameters(thetas), self._problem.spec
        starts = self._seeds(seeds, len(theta))
        if traces and not spec.trace_channels:
            raise ConfigError("traces: no channel of the task has trace=True")
        count = len(theta)
        if not count:
            sizes = ((0,), (0, len(spec.measures)), (0, len(spec.terms)), (0, *spec.trace_shape))
            none, measures, terms, trace = (np.zeros(size) for size in sizes)
            flags, empty = none.astype(bool), trace.astype("<f4") if traces else None
            return Evaluated(
                none,
                measures,
                flags if spec.success else None,
                flags,
                none.astype(int),
                terms,
                empty,
            )
        with self._turn():
            self._begin(
                Jobs.exploring(theta, (1,), starts), "all" if traces else "none", terms=True
            )
            results = self._collected()
        return Evaluated(
            returns=results.returns,
            measures=results.measures if spec.measures else np.zeros((count, 0)),
            success=results.flags[:, 0] if spec.success else None,
            failed=results.flags[:, 2],
            steps=results.steps,
            terms=results.terms,
            traces=np.stack([results.traces[row] for row in range(count)]) if traces else None,
        )

    def imap(self, thetas: Any, seeds: Iterable[int] | None = None) -> Iterator[tuple[int, float]]:  # noqa: ANN401
        """Evaluate parameters like `map`, but yield (index, return) as they arrive; a later return
        of an index replaces the earlier one.

        The call ends when its last pair was taken, or when the iterator is closed. Until then other
        calls wait.
        """
        theta = self._parameters(thetas)
        starts = self._seeds(seeds, len(theta))
        return self._as_they_come(Jobs.exploring(theta, (1,), starts)) if len(theta) else iter(())

    def _as_they_come(self, jobs: Jobs) -> Iterator[tuple[int, float]]:
        with self._turn():
            self._begin(jobs)
            yielded = np.full(len(jobs), np.nan)  # the answers of an expelled host are discarded
            for results in self._progress():
                for index in np.flatnonzero(results.done & (results.returns != yielded)).tolist():
                    yielded[index] = results.returns[index]
                    yield index, float(yielded[index])
                    if self._closed.is_set():
                        raise Stopped

    def rollout(self, theta: Any, seed: int | None = None) -> Trajectory:  # noqa: ANN401
        """One rollout at physics rate, with its channels, of parameters (P,)."""
        (one,) = self._parameters([theta])
        starts = self._seeds(None if seed is None else [seed], 1)
        with self._turn():
            self._begin(Jobs.single(one, "physics", None if starts is None else starts[0]))
            trajectory = self._collected().trajectory(0)
        assert trajectory is not None
        return trajectory

    def close(self) -> None:
        """Stop the local workers; a waiting call raises RunError.

        Closing twice is allowed; a fork closes nothing.
        """
        if self._process != os.getpid():
            return
        self._closed.set()
        within_imap = self._holder == threading.get_ident()  # an unfinished imap of this thread
        if not within_imap:
            self._taken.acquire()
        try:
            self._finish()
        finally:
            if not within_imap:
                self._taken.release()

    def __enter__(self) -> "Farm":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        """Allow one call at a time.

        Raises:
          RunError: this thread has an unfinished imap, for which it would wait forever; or the pool
              is closed.
        """
        if self._process != os.getpid():
            raise RunError(
                "this farm.Farm was opened before this process was forked: open one in a new"
                " process"
            )
        if self._holder == threading.get_ident():
            raise RunError(
                "an imap of this thread has not ended: take its last pair, or close() it, before"
                " another call"
            )
        with self._taken:
            self._holder = threading.get_ident()
            try:
                yield
            except Stopped:
                raise RunError("the pool is closed") from None
            finally:
                self._holder = None

    def _begin(self, jobs: Jobs, traces: str = "none", *, terms: bool = False) -> None:
        if self._closed.is_set():
            raise RunError("the pool is closed")
        self._round += 1
        self._pool.begin(self._round, np.zeros(self.size), jobs, traces, terms=terms)

    def _progress(self) -> Iterator[RoundResults]:
        """The round after each batch of results, and of checks: for these as long again as the
        results took, or ten seconds.
        """
        start = time.monotonic()
        yield from self._pool.progress()
        until = time.monotonic() + max(_CHECKS, time.monotonic() - start)
        for results in self._pool.progress(checked=True):
            yield results
            if time.monotonic() > until and results.done.all():
                return

    def _collected(self) -> RoundResults:
        """The whole round's results."""
        results = deque(self._progress(), maxlen=1)
        return results[0]

    def _parameters(self, thetas: Any) -> FloatArray:  # noqa: ANN401
        expected = f"expected numbers of shape (B, {self.size})"
        try:
            array = np.asarray(thetas)
        # Such as rows of different lengths, or a tensor with a gradient
        except (TypeError, ValueError, RuntimeError):
            raise ConfigError(
                f"thetas is a {type(thetas).__name__} that is not an array; {expected}"
            ) from None
        if array.shape == (0,):
            return np.empty((0, self.size))
        if array.dtype.kind not in "biuf":  # text or complex numbers would be converted
            raise ConfigError(
                f"thetas is a {type(thetas).__name__} of {array.dtype.name}; {expected}"
            )
        theta = np.ascontiguousarray(array, dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != self.size:
            raise ConfigError(f"thetas has shape {array.shape}; expected (B, {self.size})")
        if not np.isfinite(theta).all():
            row = int(np.flatnonzero(~np.isfinite(theta).all(axis=1))[0])
            raise ConfigError(f"thetas[{row}] is not finite; expected finite numbers")
        if theta.nbytes > _GATHER:
            most = _GATHER // (8 * self.size)
            raise ConfigError(
                f"thetas has {len(theta)} rows; at most {most} of {self.size} numbers are taken at"
                " a time"
            )
        return theta

    def _seeds(self, seeds: Iterable[int] | None, count: int) -> list[tuple[int, ...]] | None:
        if seeds is None:
            return None
        try:
            words = list(seeds)
        except TypeError:
            raise ConfigError(
                f"seeds is a {type(seeds).__name__}; expected {count} whole numbers"
            ) from None
        if len(words) != count:
            raise ConfigError(
                f"there are {len(words)} seeds; expected {count}, one for each row of thetas"
            )
        return [streams.numbered_start(word) for word in words]


def _finish(parts: ExitStack, closed: threading.Event, process: int) -> None:
    closed.set()
    if process == os.getpid():  # a fork must not end its parent's workers
        parts.close()
