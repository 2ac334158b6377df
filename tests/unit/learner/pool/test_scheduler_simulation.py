"""The scheduler on a simulated farm: workers join, die, hang; messages are lost, repeated, late."""

import heapq
import itertools
import math
import random
import time
from collections import Counter
from dataclasses import dataclass, field

from hypothesis import given, settings
from hypothesis import strategies as st

from learner.pool.scheduler import Scheduler, SchedulerConfig

LEASE = 3.0  # a dead or hung worker's token goes after at most this [s]


@dataclass
class SimWorker:
    name: str
    credits: int
    seconds: float  # a job
    state: str = "well"  # well, hung, dead
    detected: bool = True  # a hung one's token goes
    inbox: list = field(default_factory=list)
    busy: bool = False
    failing: float = 0.0


class Farm:
    """A learner with its scheduler, workers, and an unreliable network.

    The books here are kept apart from the scheduler's and checked against what it hands out.
    """

    def __init__(self, seed, *, jobs, rounds, loss, config):
        self.random = random.Random(seed)
        self.config, self.loss = config, loss
        self.scheduler = Scheduler(config)
        self.now, self.order, self.events = 0.0, itertools.count(), []
        self.workers, self.live = {}, set()
        self.jobs, self.rounds, self.round = jobs, rounds, 0
        self.counted, self.held, self.handled = Counter(), {}, 0
        self.answered = set()  # workers that nobody tries any more
        self.timer = math.inf
        self.scheduler.begin(jobs)

    def at(self, delay, action, *args):
        heapq.heappush(self.events, (self.now + delay, next(self.order), action, args))

    def send(self, action, *args):
        """Deliver after a while, perhaps never, perhaps twice."""
        if self.random.random() < self.loss:
            return
        for _ in range(1 + (self.random.random() < self.loss)):
            late = 5.0 if self.random.random() < self.loss / 4 else 0.02
            self.at(self.random.uniform(0.0, late), action, *args)

    # --- workers

    def join(self, worker):
        self.workers[worker.name] = worker
        self.live.add(worker.name)
        self.say(worker, idle=False)

    def say(self, worker, idle):
        """Say what it wants, and again every second without work."""
        if worker.state == "well":
            if not worker.busy and not worker.inbox:
                self.send(self.on_want, worker, idle)
            self.at(1.0, self.say, worker, True)

    def fall(self, worker, state):
        if worker.state == "well":
            worker.state = state
            if state == "dead" or worker.detected:
                self.at(self.random.uniform(0.0, LEASE), self.on_lost, worker)

    def on_chunk(self, worker, number, indices):
        if worker.state == "well":
            worker.inbox.append((number, indices))
            self.work(worker)

    def work(self, worker):
        if worker.busy or not worker.inbox or worker.state != "well":
            return
        number, indices = worker.inbox.pop(0)
        if number != self.round:  # dropped, as the announcement of the new round tells it to
            self.work(worker)
            return
        worker.busy = True
        spent = len(indices) * worker.seconds * self.random.uniform(0.5, 2.0)
        self.at(spent, self.done, worker, number, indices)

    def done(self, worker, number, indices):
        worker.busy = False
        if worker.state != "well":
            return
        failed = [i for i in indices if self.random.random() < worker.failing]
        self.send(self.on_results, worker, number, [i for i in indices if i not in failed])
        for index in failed:
            self.send(self.on_error, worker, number, index)
        self.work(worker)

    # --- the learner

    def on_want(self, worker, idle):
        if worker.name in self.live:
            if idle:
                self.held[worker.name] = {}
            self.scheduler.want(worker.name, worker.credits, self.now, idle=idle)

    def on_lost(self, worker):
        self.live.discard(worker.name)
        self.answered.discard(worker.name)
        self.held.pop(worker.name, None)
        self.scheduler.lost(worker.name)

    def on_results(self, worker, number, indices):
        now = number == self.round
        if worker.name in self.live and (
            indices if now else self.scheduler.unread(worker.name) == "stale"
        ):
            self.answered.add(worker.name)
        if not now:
            return
        verdicts = self.scheduler.results(worker.name, indices, self.now)
        for index, verdict in zip(indices, verdicts, strict=True):
            assert verdict in (("doubled", "tried") if self.counted[index] else ("new",))
            self.counted[index] += verdict == "new"
            self.held.get(worker.name, {}).pop(index, None)

    def on_error(self, worker, number, index):
        if number == self.round:
            assert not self.scheduler.error(worker.name, index, self.now)
            self.held.get(worker.name, {}).pop(index, None)

    def on_timer(self):
        self.timer = math.inf

    def hand_out(self):
        for name, indices in self.scheduler.assign(self.now):
            assert name in self.live
            assert indices
            assert len(set(indices)) == len(indices)
            jobs = self.held.setdefault(name, {})
            newcomer = name not in self.answered and bool(self.answered)
            for index in () if newcomer else indices:
                assert not self.counted[index]
                assert jobs.get(index, -math.inf) <= self.given_up()
                jobs[index] = self.now
                self.check_copies(index)
            assert len(jobs) <= self.workers[name].credits
            self.send(self.on_chunk, self.workers[name], self.round, indices)

    def given_up(self):
        """Jobs sent before this time may have been given up; those sent later have not."""
        return self.now - 10.0 * self.config.straggler_seconds + 1e-6

    def check_copies(self, index):
        holders = [jobs[index] for jobs in self.held.values() if index in jobs]
        assert sum(since > self.given_up() for since in holders) <= self.config.copies

    def turn(self):
        """Handle an event, hand out, and set the timer."""
        self.now, _, action, args = heapq.heappop(self.events)
        self.handled += 1
        action(*args)
        if self.scheduler.complete:
            assert self.counted == Counter(range(self.jobs))
            self.round += 1
            self.counted.clear()
            self.held.clear()
            if self.round < self.rounds:
                self.scheduler.begin(self.jobs)
        self.hand_out()
        deadline = self.scheduler.next_deadline(self.now)
        if deadline is not None and self.now + deadline < self.timer:
            self.timer = self.now + deadline
            self.at(max(deadline, 1e-6), self.on_timer)

    def run(self, limit):
        while self.round < self.rounds:
            assert self.now < limit, f"{self.scheduler.remaining} jobs left at {self.now}"
            assert self.handled < 50_000
            self.turn()


CONFIGS = st.builds(
    SchedulerConfig,
    copies=st.integers(1, 4),
    straggler_seconds=st.sampled_from((0.2, 1.0)),
    max_errors=st.just(10_000),
)


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32),
    jobs=st.integers(1, 60),
    others=st.integers(0, 8),
    loss=st.sampled_from((0.0, 0.1, 0.3)),
    config=CONFIGS,
)
def test_every_job_counts_once_and_every_round_ends(seed, jobs, others, loss, config):
    farm = Farm(seed, jobs=jobs, rounds=3, loss=loss, config=config)
    rng = farm.random
    seconds = rng.choice((0.001, 0.02, 0.3))
    for number in range(others):
        worker = SimWorker(
            f"other-{number}",
            rng.randint(1, 16),
            seconds * rng.choice((1.0, 1.0, 20.0)),
            detected=rng.random() < 0.7,
            failing=rng.choice((0.0, 0.0, 0.3, 1.0)),
        )
        farm.at(rng.uniform(0.0, 3.0), farm.join, worker)
        fate = rng.choice(("well", "dead", "hung", "hung"))
        if fate != "well":
            farm.at(rng.uniform(3.0, 8.0), farm.fall, worker, fate)
    healthy = SimWorker("healthy", rng.randint(1, 16), seconds)
    farm.at(rng.uniform(0.0, 10.0), farm.join, healthy)
    farm.run(limit=900.0)


def test_ten_thousand_jobs_on_a_hundred_workers_are_quick():
    scheduler = Scheduler(SchedulerConfig())
    scheduler.begin(10_000)
    names = [f"worker-{number:03}" for number in range(100)]
    chunks = []
    for number, name in enumerate(names):
        scheduler.want(name, 32, 0.0)
        chunks += [(number * 1e-5, *chunk) for chunk in scheduler.assign(0.0)]
    free_at = dict.fromkeys(names, 0.0)
    queue = []
    started, messages = time.perf_counter(), 0
    while not scheduler.complete:
        for now, worker, indices in chunks:
            free_at[worker] = max(now, free_at[worker]) + 0.01 * len(indices)
            heapq.heappush(queue, (free_at[worker], worker, indices))
        now, worker, indices = heapq.heappop(queue)
        for index in indices:  # one message each, the most there can be
            assert scheduler.results(worker, [index], now) == ["new"]
            messages += 1
        chunks = [(now, *chunk) for chunk in scheduler.assign(now)]
    assert messages == 10_000
    assert scheduler.reissued == 0
    assert time.perf_counter() - started < 2.0
