"""A learner with workers on threads of this process, over a real session on loopback."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hosts import LIES, Forging

from farm.net.session import connect, free_endpoint
from learner.pool.placement import Placement
from learner.pool.scheduler import SchedulerConfig
from learner.run.config import RunConfig
from learner.run.launch import open_run
from learner.run.states import RolledBack
from workers.config import WorkerConfig
from workers.worker import Worker


@contextmanager
def workers(endpoint: str, count: int, *files: Path, liars: int = 0) -> Iterator[None]:
    """Workers on threads of this process, some lying by the last bit; all have asked for work
    when this returns.
    """
    stop, requests = threading.Event(), threading.Semaphore(0)
    configs = [
        WorkerConfig(connect=(endpoint,), name=f"w{i}", allow_file=files) for i in range(count)
    ]

    def serve(config: WorkerConfig, lies: bool) -> None:
        with connect(config.connect, None, stop.is_set) as session:
            worker = Worker(config, Forging(session, LIES["the last bit"]) if lies else session)  # type: ignore[arg-type]
            worker.join()
            while not worker.inbox.runs and not stop.is_set():
                worker.turn()
            requests.release()
            while not stop.is_set():
                worker.turn()
            worker.close()

    threads = [
        threading.Thread(target=serve, args=(config, i < liars)) for i, config in enumerate(configs)
    ]
    try:
        for thread in threads:
            thread.start()
        for _ in threads:
            assert requests.acquire(timeout=30), "a worker has found no learner"
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(20)


def learnt(
    config: RunConfig,
    path: Path,
    count: int,
    *files: Path,
    resume: bool = False,
    liars: int = 0,
    audit: float = 0.0,
) -> dict[str, Any]:
    """The summary of a run by this number of workers; it goes back and continues if one lies.

    Without a share to check there is no checker, whose process takes seconds to start.
    """
    while True:
        place = Placement(listen=free_endpoint(), scheduler=SchedulerConfig(audit=audit))
        with (
            open_run(config, path, place, resume=resume) as run,
            workers(place.listen, count, *files, liars=liars),
            suppress(RolledBack),
        ):
            for _ in run.learn():
                pass
            return run.summary
        resume = True
