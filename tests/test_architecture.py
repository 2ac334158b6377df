"""Who may import whom, and through which door: docs/architecture.md as a test."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("farm", "workers", "learner", "assets")

MAY_IMPORT = {"assets": set(), "farm": {"assets"}, "workers": {"farm"}, "learner": {"farm"}}
"""Of the project's own packages."""

KNOWS_BOTH_SIDES = (
    *("farm/__main__.py", "farm/commands/", "farm/local.py", "farm/finished.py", "farm/export.py"),
    *("farm/experiments.py", "farm/measuring.py", "farm/chaining.py"),
)
"""The front door."""

DOORS = {
    "zenoh": ("farm/session.py",),
    "msgpack": ("farm/codec.py",),
    "tyro": ("farm/arguments.py", "farm/commands/"),
    "mujoco": (
        *("farm/gym.py", "farm/scene.py", "farm/rendering.py", "farm/playing.py"),
        "workers/",
    ),
    "gymnasium": ("farm/gym.py", "workers/environment.py"),
    "rerun": ("learner/recording/",),
    "matplotlib": ("learner/experiments/figures.py",),
    "rerun_cli": ("learner/recording/",),
    "rich": ("farm/commands/",),
    "cryptography": ("farm/commands/certificates.py",),
    "PIL": ("farm/video.py",),
    "imageio_ffmpeg": ("farm/video.py",),
}
"""The only modules that may import a package from outside."""

PURE = (
    *("farm/arrays.py", "farm/errors.py", "farm/hand.py", "farm/keys.py", "farm/policy.py", "farm/rewards.py"),
    *("farm/states.py", "farm/tactile.py", "farm/trajectory.py", "farm/tasks/", "farm/elementary.py"),
    *("learner/algorithms/", "learner/ledger/", "learner/progress.py", "workers/jobs.py"),
    *(f"learner/experiments/{name}.py" for name in ("experiment", "catalogue", "claims", "findings", "shapes")),
)
"""Modules without network, simulator, clock or file."""

IMPURE = {"os", "sys", "time", "random", "socket", "subprocess", "threading", "pathlib", "io", "datetime", "queue"}


def modules() -> Iterator[tuple[str, list[str]]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text("utf-8"))
            yield path.relative_to(ROOT).as_posix(), [name for node in ast.walk(tree) for name in _imports(node)]


def _imports(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name.partition(".")[0] for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative imports hide who imports whom"
        return [(node.module or "").partition(".")[0]]
    return []


MODULES = dict(modules())


@pytest.mark.parametrize("module", MODULES)
def test_directions(module: str) -> None:
    package = module.partition("/")[0]
    allowed = {package} | (set(PACKAGES) if module.startswith(KNOWS_BOTH_SIDES) else MAY_IMPORT[package])
    assert not (set(MODULES[module]) & set(PACKAGES)) - allowed


@pytest.mark.parametrize("module", MODULES)
def test_doors(module: str) -> None:
    for package, doors in DOORS.items():
        if package in MODULES[module]:
            assert module.startswith(doors), f"{package} has another door"


@pytest.mark.parametrize("module", [module for module in MODULES if module.startswith(PURE)])
def test_pure(module: str) -> None:
    assert not set(MODULES[module]) & (IMPURE | set(DOORS))


def test_the_lists_above_name_what_exists() -> None:
    for name in (*PURE, *KNOWS_BOTH_SIDES, *(door for doors in DOORS.values() for door in doors)):
        assert (ROOT / name).exists(), name
