"""Measures what one checking core can do: two tables.

    python benchmarks/audit.py [--workers 50,300,1000] [--seconds 5] [--repeats 20]

The first: pairs of the finger gait per second of the checker's process, as the learner uses it, and
of a worker. The second plays rounds of farms with as many workers, each of its own host, one of
which lies, with the learner's own choice of checks and a checker of that rate.
"""

import argparse
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from typing import Final

import numpy as np

from farm import seeds
from farm.net.work import Jobs, RoundHeader
from farm.runner_process import Begin
from learner.pool.audit import Audit, Check, Source
from learner.pool.checker import Checker
from learner.pool.round import RoundResults, Shapes, bits
from learner.run.config import configure
from learner.run.setup import problem

SHARE: Final = 0.02
EACH: Final = 15  # pairs of a worker in a round
CHUNK: Final = 20  # pairs in a worker's message
WARM: Final = 5  # batches before the measurement
MOST: Final = 400  # rounds after which a liar counts as not found

HEADER: Final = RoundHeader(
    run="r", incarnation="i", round=1, generation=0, spec="", traces="none", mu=np.zeros(1)
)

LIARS: Final[dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
    "all": lambda at, _: at >= 0,
    "its best of a round": lambda _, returns: returns == returns.max(),
    "one answer in 50": lambda at, _: at % 50 == 7,
}
"""Which of its answers are lies, by their numbers and returns."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--workers", default="50,300,1000")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measured rate [s]")
    parser.add_argument("--repeats", type=int, default=20, help="played farms per row")
    arguments = parser.parse_args()
    checker, worker = rates(arguments.seconds)
    print("| pairs/s of a core | as checker | as worker |\n|---|---|---|")
    print(f"| finger gait | {checker:.0f} | {worker:.0f} |\n", flush=True)
    names = " | ".join(f"found: {name}" for name in LIARS)
    print(f"| workers | a core can repeat | repeats | {names} |\n|---|---|---|---|---|---|")
    for workers in map(int, arguments.workers.split(",")):
        room = int(EACH * checker / worker)
        shares = []
        cells = []
        for lies in LIARS.values():
            played = [found(workers, room, lies, seed) for seed in range(arguments.repeats)]
            shares += [share for _, share in played]
            rounds = sorted(after for after, _ in played)
            middle = rounds[len(rounds) // 2]
            late = rounds[int(0.9 * len(rounds))]
            cells.append(f"{_shown(middle)} ({_shown(late)})")
        print(
            f"| {workers} | {room / (workers * EACH):.2%} | {np.mean(shares):.2%} |"
            f" {' | '.join(cells)} |",
            flush=True,
        )


def rates(seconds: float) -> tuple[float, float]:
    """Pairs per second of a checker, and of a worker, one after the other."""
    task = problem(configure("finger-gait"))
    mu = np.zeros(task.policy.size)
    answers = threading.Event()
    eps = 0.1 * np.random.default_rng(0).normal(size=(CHUNK, task.policy.size))
    jobs = Jobs.exploring(eps, (1, -1), [seeds.training(0, 0, at) for at in range(CHUNK)])
    with closing(task.runner()) as runner:
        results = runner.run(mu, jobs)
        answers_to = [bits(results, slice(2 * at, 2 * at + 2)) for at in range(CHUNK)]
        start = time.monotonic()
        count = 0
        while time.monotonic() < start + seconds:
            runner.run(mu, jobs)
            count += CHUNK
        worker = count / (time.monotonic() - start)
    header = replace(HEADER, mu=mu)
    begin = Begin(spec=task.specification("r"), files=(), backend="cpu", fingerprint=True)
    checks = [
        Check(Source("a", ""), header, jobs.take([at % CHUNK]), answers_to[at % CHUNK])
        for at in range(64)
    ]
    with closing(Checker(lambda _: begin, "", answers.set)) as checker:
        start = time.monotonic()
        count = -WARM
        while count < 0 or time.monotonic() < start + seconds:
            batch = checks[: checker.room]
            answers.clear()
            checker.give(batch)
            answers.wait()
            checker.findings()
            if count < 0:  # it waits for the process, and batches grow
                start = time.monotonic()
                count += 1
            else:
                count += len(batch)
        return count / (time.monotonic() - start), worker


def found(
    workers: int, room: int, lies: Callable[[np.ndarray, np.ndarray], np.ndarray], seed: int
) -> tuple[int, float]:
    """Rounds until the checker finds a liar, and the share of answers that it has repeated.

    Args:
      workers: how many, each of its own host; one lies.
      room: checks that the checker makes in the time of a round.
      lies: which of the liar's answers are lies.
      seed: of the returns and of the secret choice.
    """
    rng = np.random.default_rng(seed)
    audit = Audit(SHARE, np.random.default_rng(seed + 1000))
    count = workers * EACH
    made = 0
    lied = set[tuple[int, int]]()
    liar = int(rng.integers(workers))
    own = slice(liar * EACH, (liar + 1) * EACH)
    jobs = Jobs.exploring(np.zeros((count, 1)), (1,), None)
    for after in range(1, MOST + 1):
        results = RoundResults(jobs, "none", Shapes(trace=(0, 0), frame={}))
        results.returns[:] = rng.uniform(-1.0, 0.0, count)
        false = lies(np.arange(EACH) + EACH * (after - 1), results.returns[own])
        audit.begin(replace(HEADER, round=after), results)
        for worker in range(workers):
            source = Source(str(worker), "bits")
            audit.counted(source, np.arange(EACH) + EACH * worker)
        audit.ended()
        lied |= {(after, own.start + at) for at in np.flatnonzero(false).tolist()}
        left = room
        while left and (checks := audit.take(left)):
            left -= len(checks)
            made += len(checks)
            for check in checks:
                key = check.header.round, int(check.job.indices[0])
                if key in lied:
                    return after, made / (after * count)
                audit.found(check, "right")
    return MOST + 1, made / (MOST * count)


def _shown(rounds: int) -> str:
    return f"> {MOST}" if rounds > MOST else str(rounds)


if __name__ == "__main__":
    from running import script

    script(main)
