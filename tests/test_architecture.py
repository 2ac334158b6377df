"""Which package may import which, and through which modules: docs/architecture.md as a test."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("farm", "workers", "learner")

MAY_IMPORT = {"farm": set(), "workers": {"farm"}, "learner": {"farm"}}
"""Of the project's own packages; no module is excused."""

FLOORS = {
    "farm/sim/": ("farm.arrays", "farm.errors", "farm.noise", "farm.returns", "farm.sim"),
    "farm/net/": ("farm.arrays", "farm.errors", "farm.net", "farm.sim.trajectory"),
    "learner/pool/": ("farm", "learner.pool"),
    "farm/tasks/base.py": (
        *("farm.arrays", "farm.errors", "farm.settings", "farm.sim"),
        *("farm.tasks.actions.space", "farm.tasks.robust"),
    ),
    # Types of it
    "farm/tasks/actions/space.py": ("farm.arrays", "farm.errors", "farm.sim", "farm.tasks.base"),
    "farm/policies/": (
        "farm.arrays",
        "farm.errors",
        "farm.settings",
        "farm.elementary",
        "farm.tasks.base",
        "farm.policies",
    ),
}
"""Parts that may import only some of the project."""

DOORS = {
    "zenoh": ("farm/net/session.py",),
    "msgpack": ("farm/net/codec.py",),
    "tyro": (
        "farm/command_line.py",
        "farm/help.py",
        "farm/commands/",
        "learner/commands/",
        "learner/tools/",
        "workers/command.py",
    ),
    "mujoco": ("farm/sim/", "farm/tasks/", "learner/tools/export/npz.py", "workers/backends/"),
    "gymnasium": (
        "farm/tasks/gymnasium.py",
        "farm/tasks/gymnasium_engine.py",
        "farm/tasks/environment.py",
        "farm/tasks/finger_gait/env.py",
    ),
    "rerun": ("learner/recording/",),
    "rerun_cli": ("learner/recording/",),
    "matplotlib": ("learner/plots.py",),
    "rich": ("farm/commands/", "learner/commands/", "learner/tools/"),
    "cryptography": ("farm/commands/certificates.py",),
    "onnx": ("learner/tools/export/onnx.py",),
    "pytest": ("farm/pytest_plugin.py",),
    "cmaes": ("learner/algorithms/cma.py",),
    "PIL": ("farm/sim/video.py", "learner/tools/check/check.py"),
    "tensorboardX": ("learner/loggers/tensorboard.py",),
    "wandb": ("learner/loggers/wandb.py",),
    "pyarrow": ("learner/parquet.py",),
    "mujoco_warp": ("workers/backends/warp.py",),
    "warp": ("workers/backends/warp.py",),
    "imageio_ffmpeg": ("farm/sim/video.py",),
}
"""The only modules that may import a package from outside."""

PURE = (
    *(
        "farm/arrays.py",
        "farm/errors.py",
        "farm/elementary.py",
        "farm/moments.py",
        "farm/noise.py",
        "farm/returns.py",
        "farm/seeds.py",
        "farm/net/keys.py",
        "farm/net/work.py",
    ),
    *(
        "farm/net/messages.py",
        "farm/net/stats.py",
        "farm/sim/channels.py",
        "farm/sim/trajectory.py",
        "farm/policies/",
    ),
    "farm/tasks/robust.py",
    *(f"farm/tasks/finger_gait/{name}.py" for name in ("hand", "observations", "rewards", "touch")),
    *(
        f"learner/algorithms/{name}.py"
        for name in ("__init__", "ars", "es", "gradients", "mirrored", "pgpe", "snes", "state")
    ),
    *("learner/pool/scheduler.py", "learner/pool/job_table.py"),
    *(
        f"learner/pool/{name}.py"
        for name in ("admission", "audit", "chunking", "ledger", "round", "workforce")
    ),
)
"""Modules without network, simulator, clock or file."""

IMPURE = {
    "os",
    "sys",
    "time",
    "random",
    "socket",
    "subprocess",
    "threading",
    "pathlib",
    "io",
    "datetime",
    "queue",
}

FINGERS = re.compile(
    r"\b(finger|fingers|taxel|taxels|grip|grips|hand|hands|tactile|gait)\b", re.IGNORECASE
)
HAND = ("farm/tasks/finger_gait/",)
"""What a hand is stays in here, but for the names of plug-ins and of commands' examples."""


def modules() -> Iterator[tuple[str, ast.Module]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text("utf-8"))


def _imports(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative imports hide who imports whom"
        return [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
    return []


TREES = dict(modules())
IMPORTS = {
    name: [module for node in ast.walk(tree) for module in _imports(node)]
    for name, tree in TREES.items()
}
TOPS = {name: {module.partition(".")[0] for module in imports} for name, imports in IMPORTS.items()}


def _run_elsewhere(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """A module's own functions that are given to a thread, or to Zenoh for its own."""
    functions = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(tree):
        name = ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Call) and name in ("Thread", "_callback", "answer", "answer_asked"):
            targets = (
                [each.value for each in node.keywords if each.arg == "target"]
                if name == "Thread"
                else node.args
            )
            names = (ast.unparse(each).rpartition(".")[2] for each in targets)
            yield from (functions[each] for each in names if each in functions)


def test_a_function_says_on_which_other_thread_it_runs() -> None:
    functions = [(name, node) for name, tree in TREES.items() for node in _run_elsewhere(tree)]
    assert len(functions) >= 8
    silent = [
        f"{name}:{node.name}"
        for name, node in functions
        if "Thread: " not in (ast.get_docstring(node) or "")
    ]
    assert not silent


_REFERENCE = r"`([\w/]+\.py):([\w.]+)`"


def test_pages_name_what_exists() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    references = re.findall(_REFERENCE, page)
    assert len(references) > 20
    for name in ("decisions.md", "reliability.md"):
        text = (ROOT / "docs" / name).read_text("utf-8")
        assert re.search(_REFERENCE, text)
        page += text
    references = re.findall(_REFERENCE, page)
    for module, name in references:
        scope: ast.AST = TREES[module]
        for part in name.split("."):
            inside = {
                n.name: n
                for n in ast.iter_child_nodes(scope)
                if isinstance(n, ast.ClassDef | ast.FunctionDef)
            }
            assert part in inside, f"{module} has no {name}"
            scope = inside[part]
    for module in re.findall(r"`((?:farm|learner|workers|tests)/[\w/]+\.py)`", page):
        assert (ROOT / module).exists(), module


def test_no_arrow_runs_upward() -> None:
    for module, tops in TOPS.items():
        package = module.partition("/")[0]
        assert not (tops & {*PACKAGES, "assets", "benchmarks"}) - {package} - MAY_IMPORT[package], (
            module
        )


def test_the_learner_imports_no_tool_and_a_tool_only_that_which_replays() -> None:
    tools = "learner.tools."
    for module, imports in IMPORTS.items():
        own = module.replace("/", ".").removeprefix(tools).partition(".")[0]
        for name in imports:
            if name.startswith(tools):
                assert module.startswith("learner/tools/"), f"{module} imports {name}"
                assert name.removeprefix(tools).partition(".")[0] in (own, "replay"), (
                    f"{module} imports {name}"
                )


@pytest.mark.slow
def test_a_run_learns_without_the_tools(tmp_path: Path) -> None:
    """The same numbers from a copy of the packages in which learner/tools/ is deleted."""
    hashes = []
    for name in ("whole", "without"):
        copy = tmp_path / name
        for package in (*PACKAGES, "assets"):
            shutil.copytree(
                ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__")
            )
        if name == "without":
            shutil.rmtree(copy / "learner/tools")
        code = f"""import sys
import farm
from farm.__main__ import main
assert farm.__file__.startswith({str(copy)!r})
sys.exit(main())"""
        words = [
            "run",
            "--generations",
            "2",
            "--no-record",
            "--workers",
            "1",
            "--name",
            "r",
            "--out",
            str(copy / "runs"),
        ]
        environment = os.environ | {"PYTHONPATH": str(copy)}
        command = [sys.executable, "-c", code, *words]
        subprocess.run(
            command, cwd=tmp_path, env=environment, check=True, capture_output=True, timeout=120
        )
        hashes.append(json.loads((copy / "runs/r/summary.json").read_text())["parameters_sha256"])
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize("floor", FLOORS)
def test_floors(floor: str) -> None:
    for module, imports in IMPORTS.items():
        if module.startswith(floor):
            for name in imports:
                if name.startswith(("farm.", "learner.")):
                    assert name.startswith(FLOORS[floor]), f"{module} imports {name}"


@pytest.mark.parametrize("package", DOORS)
def test_doors(package: str) -> None:
    for module, tops in TOPS.items():
        if package in tops:
            assert module.startswith(DOORS[package]), f"{package} has another door"


def test_pure() -> None:
    for module, tops in TOPS.items():
        if module.startswith(PURE):
            assert not tops & (IMPURE | set(DOORS)), module


def test_nothing_outside_the_finger_gait_knows_fingers() -> None:
    for module, tree in TREES.items():
        if module.startswith((*HAND, "farm/tasks/actions/rhythm.py")):  # legs have gaits, too
            continue
        names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        names |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        for name in names - {"RIGHT_HAND_Z_UP"}:  # Rerun's
            assert not FINGERS.search(name.replace("_", " ")), f"{module}: {name}"


def test_the_lists_above_name_what_exists() -> None:
    for name in (*PURE, *FLOORS, *HAND, *(door for doors in DOORS.values() for door in doors)):
        assert (ROOT / name).exists(), name
