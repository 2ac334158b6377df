"""Options of the test suite."""

import copy
import logging
import signal
from collections.abc import Iterator
from dataclasses import replace

import hypothesis
import mujoco
import numpy as np
import pytest

from farm.tasks.finger_gait import holding
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.model import Hand

# Time says nothing of what is tested
hypothesis.settings.register_profile("any machine", deadline=None)
hypothesis.settings.load_profile("any machine")


# What `nohup`, or a shell's `&`, ignores is ignored in every process that the tests start, too.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--measurements", help="append what the tests measure to this file, rows of Markdown tables"
    )


@pytest.fixture(autouse=True)
def _own_logging() -> Iterator[None]:
    """Commands that run in this process set up logging: other tests do not notice."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    yield
    root.setLevel(level)
    root.handlers[:] = handlers


@pytest.fixture(scope="module")
def grips_found_once() -> Iterator[None]:
    """The search for a hand's grips, which takes longer than a rollout, is done once for each model
    in a module.

    tests/unit/farm/tasks/finger_gait/test_rollouts.py says that what it finds does not depend on
    earlier questions.
    """
    searches: dict[tuple[bytes, str], Grasping] = {}

    def find(hand: Hand) -> Grasping:
        model = np.empty(mujoco.mj_sizeModel(hand.model), np.uint8)
        mujoco.mj_saveModel(hand.model, None, model)
        key = model.tobytes(), f"{hand.object_name} {hand.pose}"
        if key not in searches:
            # Tests may change the model
            searches[key] = Grasping(replace(hand, model=copy.copy(hand.model)))
        return searches[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(holding, "Grasping", find)
        yield
