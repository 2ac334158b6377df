"""The ways in docs/architecture.md are those of a real run: its functions are called in the order
of the page.
"""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import pytest
from learning import workers
from ways import way

import farm
from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.run.config import configure
from learner.run.launch import Outputs, open_run

ROOT = f"{Path(farm.__file__).parents[1]}/"  # of the packages, which may be installed
PACKAGES = tuple(ROOT + package for package in ("farm/", "workers/", "learner/"))
Call = tuple[str, str]


def calls(folder: Path, generations: int) -> list[Call]:
    """File and name of each function that a run of the hand calls while it learns, in order;
    learner and worker.
    """
    out: list[Call] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGES):
            out.append((code.co_filename.removeprefix(ROOT), code.co_qualname))

    config, endpoint = configure("finger-gait", pairs=2, generations=generations), free_endpoint()
    with (
        profiled(note),
        open_run(config, folder, Placement(listen=endpoint), Outputs(record=True)) as run,
        workers(endpoint, 1),
    ):
        out.clear()
        for _ in run.learn():
            pass
    return out


@contextmanager
def profiled(note: Callable[[FrameType, str, object], None]) -> Iterator[None]:
    """Call a function at each call, in this thread and those that start meanwhile."""
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def station(call: Call) -> tuple[str, str]:
    """A function as the page names it: a class stands for its check."""
    return call[0], call[1].removesuffix(".__post_init__")


# In the first generation the worker builds the task, which takes some of a perturbation's ways for
# itself; in later ones reports of the generation before are on their way.
@pytest.mark.parametrize(
    ("of", "generations", "most"),
    [("a perturbation", 2, 12), pytest.param("a trace", 1, 12, marks=pytest.mark.slow)],
)
def test_a_way_is_the_pages(tmp_path: Path, of: str, generations: int, most: int) -> None:
    pytest.importorskip("rerun")
    page = way(of)
    assert len(page.stations) >= 8
    assert len(page.files) <= most
    stations = [station(call) for call in calls(tmp_path / "r", generations)]
    begins = [
        at for at, call in enumerate(stations) if call == ("learner/run/learner.py", "explored")
    ]
    assert len(begins) == generations
    first: dict[Call, int] = {}
    for at, call in enumerate(stations[begins[-1] :]):
        first.setdefault(call, at)
    missing = [each for each in page.stations if each not in first]
    assert not missing
    # A function at both ends counts where it is called first
    once = list(dict.fromkeys(page.stations))
    assert once == sorted(once, key=lambda each: first[each])
