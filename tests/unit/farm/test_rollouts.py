"""From jobs to results with a small test task: signs, origins, rates, traces; which specifications are served."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from made import POLE, pole, spec_of

from farm import plugins
from farm import rollouts as rolling
from farm.errors import ConfigError, TaskError, UnservedError
from farm.net import codec
from farm.net.messages import Spec
from farm.net.work import Jobs, Results, Simulated
from farm.policies.fourier import Direct, FeaturesConfig
from farm.rollouts import Runner, backend, build_task, served
from farm.settings import setting
from farm.sim.channels import Channel
from farm.sim.sim import Sim
from farm.tasks.base import Task, TaskConfig
from farm.tasks.probe import specification
from learner.run.config import configure
from learner.run.setup import problem
from workers.backends.cpu import CpuBackend

XML = """<mujoco><option timestep="0.01"/><worldbody>
  <body><joint name="hinge" axis="0 1 0" damping="0.1"/><geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02"/></body>
  </worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""


class Pole(Task):
    """A pole that falls from any angle, if it is given a seed."""

    @dataclass(frozen=True, kw_only=True)
    class Config(TaskConfig):
        """Its own settings."""

        width: float = setting(3.0, above=0.0)
        """Angle at which it has fallen [rad]."""

    xml = XML
    steps, substeps = 5, 2
    channels = (
        Channel(name="angle", kind="scalars", shape=(1,), trace=True),
        Channel(name="turned", kind="flags", shape=(1,)),
    )

    def reset(self, sim, row, rng):
        """Turn it."""
        sim.qpos[row, 0] = 0.1 if rng is None else rng.uniform(-1.0, 1.0)

    def reward(self, sim, action):
        """Upright."""
        return np.cos(sim.qpos[:, 0])

    def ended(self, sim):
        """It fell."""
        return np.abs(sim.qpos[:, 0]) > self.config.width

    def success(self, sim):
        """To the right."""
        return sim.qpos[:, 0] > 0.0

    def measure(self, sim):
        """Its angle."""
        return {"angle": sim.qpos, "turned": (sim.qpos > 0.0).astype(float)}


@pytest.fixture(scope="module")
def runner():
    task = Pole()
    spec, config = specification(task), FeaturesConfig(features=10)
    return Runner(task, Direct(config, spec, Direct.draw(config, spec, np.random.default_rng(0))))


P = 10
MU = np.random.default_rng(1).normal(0.0, 1.0, P)
EPS = np.random.default_rng(2).normal(0.0, 2.0, (4, P))
SEEDS = [(1, 2, 3, i) for i in range(4)]


def same(one: Simulated, rows, other: Simulated, at) -> None:
    assert one.returns[rows].tobytes() == other.returns[at].tobytes()
    assert one.flags[rows].tobytes() == other.flags[at].tobytes()


# ---------------------------------------------------------------- jobs


@pytest.mark.parametrize("seeds", [None, SEEDS])
def test_a_pair_is_two_single_rollouts_from_the_same_start(runner, seeds):
    pairs = runner.run(MU, Jobs.exploring(EPS, (1, -1), seeds))
    assert len(set(pairs.returns.tolist())) == 8
    for column, sign in enumerate((1, -1)):
        same(pairs, slice(column, None, 2), runner.run(MU, Jobs.exploring(EPS, (sign,), seeds)), slice(None))
    alone = Jobs.single(MU - EPS[2], "none", seeds[2] if seeds else None)
    same(pairs, [5], runner.run(9.0 * MU, alone), [0])


def test_jobs_do_not_know_of_each_other_and_their_rate_changes_no_figure(runner):
    jobs = Jobs.joined(
        [
            Jobs.exploring(EPS[:2], (1, -1), SEEDS[:2]),
            Jobs.mean("control", [None, SEEDS[3]]),
            Jobs.single(MU, "physics", None),
            Jobs.mean("physics", [SEEDS[3]]),
            Jobs.mean("none", [None, SEEDS[3]]),
        ]
    )
    together = runner.run(MU, jobs, "all")
    for row in (5, 7):  # the mean at control rate, at physics rate, and unseen
        same(together, [row], together, [9])
    for row in (4, 6):
        same(together, [row], together, [8])
    starts = np.cumsum(jobs.rollouts) - jobs.rollouts
    shown = iter(together.trajectories)
    for at in range(len(jobs)):
        alone = runner.run(MU, jobs.take([at]), "all")
        same(alone, slice(None), together, slice(starts[at], starts[at] + jobs.rollouts[at]))
        if jobs.seen[at]:
            [own] = alone.trajectories
            assert codec.encode(next(shown)) == codec.encode(own)
    frames = [len(trajectory.times) for trajectory in together.trajectories]
    assert frames == [6, 6, 11, 11]
    assert [t.value for t in together.trajectories] == together.returns[4:8].tolist()


def test_what_is_sent_is_what_the_receiver_expects(runner):
    jobs = Jobs.joined([Jobs.mean("control", [None]), Jobs.exploring(EPS, (1, -1), SEEDS)])
    head = {"run": "r", "incarnation": "i", "round": 0, "worker": "w/0"}
    for traces, count in (("none", 0), ("extremes", 2), ("all", 8)):
        sent = Results.carrying(runner.run(MU, jobs, traces), jobs, 0.0, **head)
        back = codec.decode(codec.encode(sent), Results)
        assert back.traces.shape[1:] == (5, 1)
        assert len(back.traces) == count
        assert back.trajectories[0].fits(runner.spec.shapes(len(runner.scene.bodies)))
    best, worst = int(back.returns[1:].argmax()), int(back.returns[1:].argmin())
    two = runner.run(MU, jobs, "extremes").traces
    assert two.tobytes() == back.traces[sorted((best, worst))].tobytes()


def test_an_end_and_its_trace(runner):
    fallen = Runner(Pole(Pole.Config(width=0.5)), runner.policy)
    given = fallen.run(MU, Jobs.exploring(EPS, (1,), SEEDS), "all")
    assert 0 < given.flags[:, 1].sum() < 4
    for row in range(4):
        last = np.flatnonzero(given.traces[row, :, 0])[-1]
        assert (last < 4 or abs(given.traces[row, last, 0]) > 0.5) == given.flags[row, 1]
        assert given.flags[row, 0] == (given.traces[row, last, 0] > 0)
    fallen.close()


@pytest.mark.parametrize("size", [1e200, 1e308])
def test_absurd_parameters_are_answered(runner, size):
    theta = np.where(np.arange(P) % 2, 1.0, -1.0) * size
    given = runner.run(MU, Jobs.single(theta, "control", None))
    assert np.isfinite(given.returns).all()
    codec.decode(codec.encode(given.trajectories[0]), type(given.trajectories[0]))


def test_the_seed_is_all_there_is_to_a_start(runner):
    given = runner.run(MU, Jobs.mean("none", [SEEDS[0], SEEDS[0], SEEDS[1], None]))
    assert given.returns[0] == given.returns[1]
    assert len(set(given.returns.tolist())) == 3


# ---------------------------------------------------------------- specifications


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return pole(tmp_path)


@pytest.fixture
def spec(file: Path) -> Spec:
    """What a learner says of a task in that file."""
    drawn = specification(plugins.find("tasks", f"{file}:Pole").target())
    constants = Direct.draw(FeaturesConfig(features=4), drawn, np.random.default_rng(0))
    said = spec_of(file, "direct", task_config={"steps": 2}, policy_config={"features": 4}, constants=constants)
    return codec.decode(codec.encode(said), Spec)


def test_it_is_built_as_it_is_specified(spec, file):
    task, policy = served(spec, (file,))
    assert spec.task == "pole.py:Pole", "a file is named without its folder"
    assert (task.steps, policy.size) == (2, 4)
    heavier = task.sources["model.xml"].replace('mass="1"', 'mass="5"')
    other, _ = served(replace(spec, files={"model.xml": heavier}), (file,))
    assert (task.model.body_mass[1], other.model.body_mass[1]) == (1.0, 5.0), "the run's texts count"
    made = [Runner(*served(spec, (file,))).run(np.ones(4), Jobs.mean("none", [None])) for _ in range(2)]
    assert made[0].returns.tobytes() == made[1].returns.tobytes()


def test_a_file_is_served_by_permission_only_and_only_if_it_is_the_same(spec, file, tmp_path):
    with pytest.raises(UnservedError, match=r"pole\.py is a file on the learner's machine: .* --allow-file pole\.py"):
        served(spec)
    other = tmp_path / "other.py"
    other.write_text(POLE)
    with pytest.raises(UnservedError, match="--allow-file pole.py"):
        served(spec, (other,))
    changed = pole(tmp_path / "changed", POLE + "\nraise RuntimeError('it was imported')\n")
    with pytest.raises(UnservedError, match=r"pole\.py differs from the learner's pole\.py: copy the learner's"):
        served(spec, (changed,))
    with pytest.raises(UnservedError, match="has no class 'Hole'; it has Pole"):
        served(replace(spec, task="pole.py:Hole"), (file,))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("task", "pole.py differs from the learner's"),
        ("policy", "its code of 'direct' differs from the learner's: install the learner's release on both sides"),
        ("simulation", r"its simulation's code differs from the learner's \(farm/\)"),
    ],
)
@pytest.mark.parametrize("digest", ["0" * 64, None])
def test_other_code_is_refused_and_named(spec, file, name, words, digest):
    code = {key: value for key, value in spec.code.items() if key != name}
    with pytest.raises(UnservedError, match=words):
        served(replace(spec, code=code if digest is None else code | {name: digest}), (file,))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"task": "juggling"},
            r"unknown task 'juggling'; known are finger-gait, fragile-bar, turning, gym, or FILE\.py:CLASS",
        ),
        ({"policy": "pid"}, "unknown policy 'pid'; known are direct"),
        ({"policy_release": "mine 2"}, "the run uses direct of mine 2, but here direct belongs to rolloutfarm"),
        (
            {"task": "finger-gait", "release": "theirs 1"},
            "the run uses finger-gait of theirs 1, but here finger-gait belongs to rolloutfarm",
        ),
        ({"task_release": "gymnasium 9"}, "the run uses pole.py:Pole of gymnasium 9, but .* is installed here"),
        ({"task_config": {"colour": "red"}}, "pole.py:Pole: unknown setting colour; known are steps"),
        ({"task_config": {"steps": "15"}}, "steps is '15'; expected int"),
        ({"task_config": {"steps": np.array([15, 15])}}, "steps is .*; expected int"),
        ({"task_config": {"gamma": None}}, "gamma is None; expected float"),
        ({"policy_config": {"bandwidth": np.ones(2)}}, "bandwidth is .*; expected float"),
        ({"policy_config": {"depth": 3}}, "direct: unknown setting depth"),
        ({"policy_config": {b"features": 50}}, "direct: unknown setting b'features'"),
        ({"constants": {}}, "constant 'frequencies' of the policy is missing"),
        ({"constants": {b"frequencies": np.zeros((4, 2)), "phases": np.zeros(4)}}, "'frequencies' .* is missing"),
        ({"files": {}}, "has no model"),
        ({"files": {"model.xml": "<mujoco>"}}, "MuJoCo refuses the model"),
    ],
    ids=str,
)
def test_a_specification_that_makes_no_sense_is_a_clear_error(spec, file, change, words):
    with pytest.raises(UnservedError, match=words) as caught:
        served(replace(spec, **change), (file,))
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_that_changes_meanwhile_is_what_it_is_now(spec, file):
    """A worker goes on from run to run; the file that it may serve is edited on both sides."""
    served(spec, (file,))
    file.write_text(POLE.replace("steps = 4", "steps = 7"))
    with pytest.raises(UnservedError, match="differs from the learner's"):
        served(spec, (file,))
    code = spec.code | {"task": plugins.find("tasks", f"{file}:Pole").digest()}
    task, _ = served(replace(spec, code=code, task_config={}), (file,))
    assert task.steps == 7


def test_what_is_no_task_is_no_task(spec, tmp_path):
    """A file that may be served still gives no class of another kind."""
    path = tmp_path / "pole.py"
    path.write_text("class Pole:\n    pass\n")
    code = spec.code | {"task": plugins.find("tasks", f"{path}:Pole").digest()}
    with pytest.raises(UnservedError, match="pole.py:Pole is not a Task"):
        served(replace(spec, code=code), (path,))


def test_backends_by_name(tmp_path):
    assert isinstance(backend("cpu"), CpuBackend)
    with pytest.raises(ConfigError, match="unknown backend 'gpu'; known are cpu"):
        backend("gpu")
    path = tmp_path / "mine.py"
    path.write_text("import farm\nclass Mine(farm.Task):\n    def __init__(self): pass\n")
    with pytest.raises(ConfigError, match=r"mine.py:Mine is no backend: it needs capacity and engine"):
        backend(f"{path}:Mine")
    with pytest.raises(ConfigError, match=r"its __init__ must take config, variant and files"):
        build_task(plugins.find("tasks", f"{path}:Mine"), {}, None)
    assert rolling.SIMULATION == "farm.tasks.loop"


def test_backends_that_cannot_be_are_named(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("class Mine:\n    capacity = 'x'\n    def engine(self, model): return 3\n")
    with pytest.raises(ConfigError, match="mine.py:Mine is 'x'; expected a whole number of at least 1"):
        backend(f"{path}:Mine")
    with pytest.raises(TaskError, match="the backend gave a int, which is no engine: it has no model, size, field"):
        Sim(3)


# ---------------------------------------------------------------- policies of one's own

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


@pytest.mark.parametrize(
    ("members", "size", "line"),
    [
        ("pass", "'x'", "size of mine.py:Mine is 'x'; expected a whole number of at least 1"),
        ("pass", "0", "size of mine.py:Mine is 0"),
        ("pass", "2.5", "size of mine.py:Mine is 2.5"),
        ("def __init__(self): pass", "2", "mine.py:Mine: its __init__ must take config, spec and constants"),
        ("draw = classmethod(lambda *_: None)", "2", "draw of mine.py:Mine gave None; expected finite float64 arrays"),
        ("draw = classmethod(lambda *_: {'a': np.arange(3)})", "2", "draw of mine.py:Mine gave {'a': array"),
        ("draw = classmethod(lambda *_: {'a': np.array([np.inf])})", "2", "draw of mine.py:Mine gave {'a': array"),
    ],
)
def test_a_policy_of_ones_own_that_cannot_be_is_named(tmp_path, file, members, size, line):
    path = tmp_path / "mine.py"
    path.write_text(POLICY.format(members, size))
    with pytest.raises(ConfigError, match=line):
        problem(configure(f"{file}:Pole", policy=f"{path}:Mine"))


@pytest.mark.parametrize(
    ("given", "got"),
    [
        ("np.zeros(3)", r"array of float64 \(3,\)"),
        ("np.zeros((2, 1))", r"array of float64 \(2, 1\)"),
        ("np.array([0.0, np.nan])", r"array of float64 \(2,\)"),
        ("np.array([1, 2])", r"array of int64 \(2,\)"),
        ("[0.0, 0.0]", "list"),
    ],
)
def test_a_start_that_cannot_be_is_named(tmp_path, file, given, got):
    path = tmp_path / "mine.py"
    path.write_text(POLICY.format(f"def start(self, rng): return {given}", "2"))
    line = f"start of mine.py:Mine gave an? {got}; expected 2 finite numbers of float64, or None$"
    with pytest.raises(ConfigError, match=line):
        problem(configure(f"{file}:Pole", policy=f"{path}:Mine")).begin()


@pytest.mark.parametrize(
    ("given", "got"),
    [
        ("np.zeros((2, 1))", r"array of float64 \(2, 1\)"),
        ("np.array([np.inf])", r"array of float64 \(1,\)"),
        ("np.array([1, 2])", r"array of int64 \(2,\)"),
        ("0.0", "float"),
    ],
)
def test_a_memory_that_cannot_be_is_named(tmp_path, file, given, got):
    path = tmp_path / "mine.py"
    path.write_text(POLICY.format(f"memory = {given}", "2"))
    line = f"memory of mine.py:Mine gave an? {got}; expected a vector of finite numbers of float64, or None$"
    with pytest.raises(ConfigError, match=line):
        problem(configure(f"{file}:Pole", policy=f"{path}:Mine"))


def test_a_start_of_ones_own_is_added_to_the_algorithms_mean(tmp_path, file):
    path = tmp_path / "mine.py"
    path.write_text(POLICY.format("def start(self, rng): return np.array([2.0, -3.0])", 2))
    for algorithm in ("pgpe", "es", "sep-cma"):
        found = problem(configure(f"{file}:Pole", policy=f"{path}:Mine", algorithm=algorithm, initial_mu=0.5))
        assert found.begin().mu.tolist() == [2.5, -2.5]


def test_prepared_values_are_one_array():
    task, config = Pole(Pole.Config()), FeaturesConfig(features=3)
    policy = Direct(config, specification(task), Direct.draw(config, specification(task), np.random.default_rng(0)))
    policy.prepare = lambda theta: (theta, theta[:, :1])
    with pytest.raises(TaskError, match="prepare of the policy gave a tuple; expected one array, with a row"):
        Runner(task, policy).rollouts(np.zeros((2, 3)), [None, None])


def test_prepared_values_need_a_row_for_each_rollout():
    task, config = Pole(Pole.Config()), FeaturesConfig(features=3)
    policy = Direct(config, specification(task), Direct.draw(config, specification(task), np.random.default_rng(0)))
    policy.prepare = lambda theta: theta[:1]
    line = r"prepare of the policy gave an array of shape \(1, 3\); expected an array of shape \(2, 3\)"
    with pytest.raises(TaskError, match=line):
        Runner(task, policy).rollouts(np.zeros((2, 3)), [None, None])


LEAVES = """
import sys
import numpy as np
import farm

class Leaves(farm.Task):
    xml = '''XML'''
    steps = 3

    def reward(self, sim, action):
        return np.cos(sim.qpos[:, 0]) if sim.t < 2 else sys.exit(5)
"""


def test_a_task_that_exits_is_an_error_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "leaves.py"
    path.write_text(LEAVES.replace("XML", XML))
    line = path.read_text().partition("sys.exit")[0].count("\n") + 1
    found = problem(configure(f"{path}:Leaves", policy="constant"))
    words = rf"^sys\.exit\(5\) in leaves\.py, line {line}: raise an error instead$"
    with pytest.raises(TaskError, match=words) as raised:
        found.runner().rollouts(np.zeros((1, found.policy.size)), [None])
    assert plugins.author_traceback(raised.value)[0].startswith(f'  File "{path}", line {line}, in reward')
    assert plugins.author_traceback(raised.value)[-1] == "SystemExit: 5"


def test_a_task_that_exits_when_it_is_made(tmp_path: Path) -> None:
    path = tmp_path / "leaves.py"
    made = "    steps = 3\n\n    def files(self):\n        sys.exit(0)"
    path.write_text(LEAVES.replace("XML", XML).replace("    steps = 3", made))
    with pytest.raises(TaskError, match=r"^sys\.exit\(0\) in leaves\.py, line"):
        problem(configure(f"{path}:Leaves"))
