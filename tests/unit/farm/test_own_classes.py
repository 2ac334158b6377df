"""Backends, policies and tasks of one's own: an error names what they gave and what was
expected.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import POLE, pole

from farm import plugins
from farm.errors import ConfigError, TaskError
from farm.runner import build_task, make_backend
from farm.sim.sim import Sim
from learner.run.config import RunConfig, configure
from learner.run.setup import problem
from workers.backends.cpu import CpuBackend


def test_backends_by_name(tmp_path):
    assert isinstance(make_backend("cpu"), CpuBackend)
    with pytest.raises(ConfigError, match="unknown backend 'gpu'; known are cpu"):
        make_backend("gpu")
    path = pole(
        tmp_path, "import farm\nclass Mine(farm.Task):\n    def __init__(self): pass\n", "mine.py"
    )
    with pytest.raises(
        ConfigError, match=r"mine.py:Mine is no backend: it needs capacity and engine"
    ):
        make_backend(f"{path}:Mine")
    with pytest.raises(ConfigError, match=r"its __init__ must take config, variant and files"):
        build_task(plugins.find("tasks", f"{path}:Mine"), {}, None)


def test_backends_that_cannot_be_are_named(tmp_path):
    path = pole(
        tmp_path,
        "class Mine:\n    capacity = 'x'\n    def engine(self, model): return 3\n",
        "mine.py",
    )
    with pytest.raises(
        ConfigError, match="mine.py:Mine is 'x'; expected a whole number of at least 1"
    ):
        make_backend(f"{path}:Mine")
    with pytest.raises(
        TaskError, match="the backend gave a int, which is no engine: it has no model, size, field"
    ):
        Sim(3)


POLICY = """
import numpy as np
import farm

class Mine(farm.Policy):
    {0}

    @property
    def size(self):
        return {1}

    def act(self, prepared, x):
        return prepared[:, :1]
"""


def mine(folder: Path, members: str, size: str = "2", **settings: Any) -> RunConfig:
    """A run with such a policy."""
    task, policy = pole(folder), pole(folder, POLICY.format(members, size), "mine.py")
    return configure(f"{task}:Pole", policy=f"{policy}:Mine", **settings)


@pytest.mark.parametrize(
    ("members", "size", "line"),
    [
        ("pass", "'x'", "size of mine.py:Mine is 'x'; expected a whole number of at least 1"),
        ("pass", "0", "size of mine.py:Mine is 0"),
        ("pass", "2.5", "size of mine.py:Mine is 2.5"),
        (
            "memory = np.zeros(2)",
            "2",
            r"mine.py:Mine: act\(prepared, x\); expected \(prepared, x, memory\)",
        ),
        (
            "def prepare(self): pass",
            "2",
            r"mine.py:Mine: prepare\(\); expected \(theta\)",
        ),
        (
            "def __init__(self): pass",
            "2",
            "mine.py:Mine: its __init__ must take config, spec and constants",
        ),
        (
            "draw = classmethod(lambda *_: None)",
            "2",
            "draw of mine.py:Mine gave None; expected finite float64 arrays",
        ),
        (
            "draw = classmethod(lambda *_: {'a': np.arange(3)})",
            "2",
            "draw of mine.py:Mine gave {'a': array",
        ),
        (
            "draw = classmethod(lambda *_: {'a': np.array([np.inf])})",
            "2",
            "draw of mine.py:Mine gave {'a': array",
        ),
    ],
)
def test_a_policy_of_ones_own_that_cannot_be_is_named(tmp_path, members, size, line):
    with pytest.raises(ConfigError, match=line):
        problem(mine(tmp_path, members, size))


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("size", "mine.py:Mine has no size: the number of its parameters"),
        ("act", r"mine.py:Mine has no act\(self, prepared, x\): its actions"),
    ],
)
def test_a_policy_that_lacks_something_is_named(tmp_path, name, line):
    config = mine(tmp_path, "pass")
    file = tmp_path / "mine.py"
    file.write_text(file.read_text().replace(f"def {name}(", f"def _{name}("))
    with pytest.raises(ConfigError, match=line):
        problem(config)


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        ("np.zeros(3)", r"array of float64 \(3,\)"),
        ("np.zeros((2, 1))", r"array of float64 \(2, 1\)"),
        ("np.array([0.0, np.nan])", r"array of float64 \(2,\)"),
        ("np.array([1, 2])", r"array of int64 \(2,\)"),
        ("[0.0, 0.0]", "list"),
    ],
)
def test_a_start_that_cannot_be_is_named(tmp_path, value, kind):
    line = f"start of mine.py:Mine gave an? {kind}; expected 2 finite numbers of float64, or None$"
    with pytest.raises(ConfigError, match=line):
        problem(mine(tmp_path, f"def start(self, rng): return {value}")).begin()


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        ("np.zeros((2, 1))", r"array of float64 \(2, 1\)"),
        ("np.array([np.inf])", r"array of float64 \(1,\)"),
        ("np.array([1, 2])", r"array of int64 \(2,\)"),
        ("0.0", "float"),
    ],
)
def test_a_memory_that_cannot_be_is_named(tmp_path, value, kind):
    line = (
        f"memory of mine.py:Mine gave an? {kind}; expected a vector of finite numbers of float64,"
        " or None$"
    )
    with pytest.raises(ConfigError, match=line):
        problem(mine(tmp_path, f"memory = {value}"))


def test_a_start_of_ones_own_is_added_to_the_algorithms_mean(tmp_path):
    start = "def start(self, rng): return np.array([2.0, -3.0])"
    for algorithm in ("pgpe", "es", "sep-cma"):
        setup = problem(mine(tmp_path, start, algorithm=algorithm, initial_mu=0.5))
        assert setup.begin().mu.tolist() == [2.5, -2.5]


def test_prepared_values_are_one_array(tmp_path):
    setup = problem(configure(f"{pole(tmp_path)}:Pole", policy="direct", features=3))
    setup.policy.prepare = lambda theta: (theta, theta[:, :1])
    with pytest.raises(
        TaskError, match="prepare of the policy gave a tuple; expected one array, with a row"
    ):
        setup.runner().rollouts(np.zeros((2, 3)), [None, None])


def test_prepared_values_need_a_row_for_each_rollout(tmp_path):
    setup = problem(configure(f"{pole(tmp_path)}:Pole", policy="direct", features=3))
    setup.policy.prepare = lambda theta: theta[:1]
    line = (
        r"prepare of the policy gave an array of shape \(1, 3\); expected an array of shape"
        r" \(2, 3\)"
    )
    with pytest.raises(TaskError, match=line):
        setup.runner().rollouts(np.zeros((2, 3)), [None, None])


RETURN = "return np.cos(sim.qpos[:, 0])"
LEAVES = "import sys\n" + POLE.replace(RETURN, f"{RETURN} if sim.t < 2 else sys.exit(5)")


def test_a_task_that_exits_is_an_error_with_its_line(tmp_path: Path) -> None:
    path = pole(tmp_path, LEAVES, "leaves.py")
    line = LEAVES.partition("sys.exit")[0].count("\n") + 1
    setup = problem(configure(f"{path}:Pole", policy="constant"))
    words = rf"^sys\.exit\(5\) in leaves\.py, line {line}: raise an error instead$"
    with pytest.raises(TaskError, match=words) as raised:
        setup.runner().rollouts(np.zeros((1, setup.policy.size)), [None])
    assert plugins.author_traceback(raised.value)[0].startswith(
        f'  File "{path}", line {line}, in reward'
    )
    assert plugins.author_traceback(raised.value)[-1] == "SystemExit: 5"


def test_a_task_that_exits_when_it_is_made(tmp_path: Path) -> None:
    path = pole(
        tmp_path,
        LEAVES.replace("steps = 4\n", "steps = 4\n\n    def files(self):\n        sys.exit(0)\n"),
        "leaves.py",
    )
    with pytest.raises(TaskError, match=r"^sys\.exit\(0\) in leaves\.py, line"):
        problem(configure(f"{path}:Pole"))
