"""Estimates what a pipeline would bring, in which a generation is drawn before the last one has ended; two tables.

    python benchmarks/lag.py [--first 20] [--seeds 10] [--delay 0.02] [--seconds 15]

With a lag of one, workers never wait for the learner, but each generation is drawn from a state that is older by one
update. The first table shows the cost: rollouts until the mean policy of the finger gait succeeds from then on, with
and without the lag. The second shows the gain: the rate of two learners that share two workers, and fill the gaps that
each other leaves, compared with one learner; on this machine, and with a network delay (a relay that delays all data
by the same time in each direction). A pipeline has two generations under way as well, so this is about its rate.
"""

import argparse
import asyncio
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np
from scaling import process, progress

from farm import seeds
from farm.arrays import FloatArray
from farm.net.session import free_endpoint
from farm.rollouts import Runner
from learner import setup
from learner.config import RunConfig, configure
from learner.learner import explored

TRIALS: Final = 40
ENOUGH: Final = 38  # of them
ROLLOUTS: Final = 600  # of a run; the mean policy is tried after every generation
SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "5 pairs (default)": {},
    "15 pairs": {"pairs": 15, "learning_rate_mu": 0.15},
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=20, help="the first seed")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--delay", type=float, default=0.02, help="delay of the network, each way [s]")
    parser.add_argument("--seconds", type=float, default=15.0, help="duration of each measurement of a rate")
    arguments = parser.parse_args()
    print("| settings | lag | rollouts until robust success for good, seed by seed | median |\n|---|---|---|---|")
    runner: Runner | None = None
    for name, values in SETTINGS.items():
        for lag in (0, 1):
            found = []
            for seed in range(arguments.first, arguments.first + arguments.seeds):
                config = configure("finger-gait", "default", seed=seed, **values)
                rollouts, runner = learnt(config, lag, runner)
                found.append(rollouts)
            shown = ", ".join("never" if each == np.inf else f"{each:.0f}" for each in found)
            print(f"| {name} | {lag} | {shown} | {median(found):.0f} |", flush=True)
    print(
        "\n| settings | delay [ms] | one learner [rollouts/s] | two learners, together | ratio |\n|---|---|---|---|---|"
    )
    for name, values in SETTINGS.items():
        for delay in (0.0, arguments.delay):
            one, two = (rate(learners, values, delay, arguments.seconds) for learners in (1, 2))
            print(f"| {name} | {1e3 * delay:.0f} | {one:.0f} | {two:.0f} | {two / one:.2f} |", flush=True)


def learnt(config: RunConfig, lag: int, runner: Runner | None) -> tuple[float, Runner]:
    """Rollouts until the mean policy succeeds and continues to, or infinity; and the simulation, to be used again."""
    problem, algorithm = setup.problem(config), config.algorithm_config
    runner = runner or problem.runner()
    runner.policy = problem.policy
    state, trials = algorithm.init(problem.policy.size), [seeds.trial(0, i) for i in range(TRIALS)]
    drawn: list[tuple[FloatArray, Any, FloatArray]] = []
    done, failing = 0, -1
    for generation in range(ROLLOUTS // (2 * algorithm.pairs) + 1):
        mean = runner.rollouts(np.repeat(state.mu[None], TRIALS, axis=0), trials)
        failing = done if mean.success.sum() < ENOUGH else failing
        while len(drawn) <= lag:  # with a lag, the first two generations have the same state
            ahead = algorithm_state(state, generation + len(drawn))
            drawn.append((*explored(config, ahead), state.mu))
        eps, jobs, mu = drawn.pop(0)
        returns = runner.run(mu, jobs).returns.reshape(-1, 2)
        state = algorithm.tell(state, eps, returns)
        done += returns.size
    last = failing + 2 * algorithm.pairs
    return (float(last) if failing >= 0 else 0.0) if last < done else np.inf, runner


def algorithm_state(state: Any, generation: int) -> Any:  # noqa: ANN401  an algorithm's
    """The state, from which the random numbers of this generation are drawn."""
    return type(state).from_dict(state.to_dict() | {"generation": generation})


def rate(learners: int, values: dict[str, Any], delay: float, seconds: float) -> float:
    """Exploring rollouts per second of learners that share two workers, after a second of both."""
    words = [word for name, value in values.items() for word in ("--" + name.replace("_", "-"), str(value))]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        router, near = free_endpoint(), free_endpoint()
        stack.enter_context(process(["-m", "farm", "router", "--listen", router], folder))
        stack.enter_context(relay(near, router, delay))
        stack.enter_context(process(["-m", "farm", "worker", "--processes", "2", "--connect", near], folder))
        run = ["-m", "farm", "learner", "--connect", router, "--no-record", "--generations", "1000000", *words]
        runs = [Path(folder, "runs", f"r{i}") for i in range(learners)]
        for each in runs:
            stack.enter_context(process([*run, "--name", each.name], folder))
        while not all(_rollouts(each) for each in runs):
            time.sleep(0.1)
        time.sleep(1.0)
        begun, before = time.monotonic(), sum(_rollouts(each) for each in runs)
        time.sleep(seconds)
        return (sum(_rollouts(each) for each in runs) - before) / (time.monotonic() - begun)


def _rollouts(run: Path) -> int:
    """Exploring rollouts so far."""
    generations = progress(run)
    return generations[-1]["rollouts"] if generations else 0


@contextmanager
def relay(listen: str, to: str, delay: float) -> Iterator[None]:
    """A relay from one endpoint to another, which holds back what it receives for this long, in both directions."""

    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        loop, held = asyncio.get_running_loop(), asyncio.Queue[tuple[float, bytes]]()

        async def deliver() -> None:
            while True:
                due, data = await held.get()
                await asyncio.sleep(max(0.0, due - loop.time()))
                writer.write(data)

        task = loop.create_task(deliver())
        try:
            while data := await reader.read(1 << 20):
                held.put_nowait((loop.time() + delay, data))
        finally:
            task.cancel()
            writer.close()

    async def joined(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(*_address(to))
        await asyncio.gather(carry(reader, back), carry(there, writer), return_exceptions=True)

    async def serve(over: asyncio.Event) -> None:
        async with await asyncio.start_server(joined, *_address(listen)):
            ready.set()
            await over.wait()

    loop, over, ready = asyncio.new_event_loop(), asyncio.Event(), threading.Event()
    thread = threading.Thread(target=loop.run_until_complete, args=(serve(over),), daemon=True)
    thread.start()
    ready.wait()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(5.0)


def _address(endpoint: str) -> tuple[str, int]:
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return host, int(port)


if __name__ == "__main__":
    from running import script

    script(main)
