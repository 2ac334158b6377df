"""The shape of the project: `python -m tests.house` prints one line per count, and fails if an aim
is missed.

The ways of a perturbation and of a trace are counted on docs/architecture.md;
`tests/loop/test_ways.py` follows a run along them.
"""

import ast
import re
import sys
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Final

import farm
from tests.shared.ways import way

ROOT: Final = Path(__file__).parent.parent
PACKAGES: Final = ("farm", "workers", "learner")


def sources() -> list[Path]:
    """Modules of the three packages."""
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def lines(paths: Iterable[Path]) -> int:
    """Lines of files."""
    return sum(len(path.read_text("utf-8").splitlines()) for path in paths)


def circles() -> list[str]:
    """Import circles, each as its modules; imports within functions count, those for annotations
    alone do not.
    """
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sources()}
    graph = {
        name: {each for each in _imported(path) if each in names and each != name}
        for name, path in names.items()
    }
    loops = []
    while True:
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            circle = error.args[1]
            loops.append(" -> ".join(circle))
            graph[circle[1]] = graph[circle[1]] - {circle[0]}
        else:
            return loops


def _imported(path: Path) -> Iterator[str]:
    for node in _executed(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _executed(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those under `if TYPE_CHECKING`."""
    yield tree
    for child in ast.iter_child_nodes(tree):
        if not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)):
            yield from _executed(child)


PARTICIPLES: Final = frozenset(
    "asked begun chosen drawn found given gone heard held kept known lost made mine named own read"
    " said seen sent shown taken theirs there told tried used wanted".split()
)


def participles() -> int:
    """Variables and arguments of the packages' functions that are called by a participle or a
    pronoun.
    """
    count = 0
    for path in sources():
        for function in (
            node
            for node in ast.walk(ast.parse(path.read_text("utf-8")))
            if isinstance(node, ast.FunctionDef)
        ):
            nodes = list(ast.walk(function))
            names = {
                each.id
                for each in nodes
                if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
            }
            count += len(
                PARTICIPLES & (names | {each.arg for each in nodes if isinstance(each, ast.arg)})
            )
    return count


def private_uses() -> int:
    """Private names that tests use: `thing._name`, also in a string, or imported; but for a
    test's own `self`.
    """
    uses = re.compile(r"(?<!\bself)(?<!\bcls)\._(?!_)[A-Za-z]\w*|import _\w+")
    return sum(
        len(uses.findall(path.read_text("utf-8")))
        for path in sorted((ROOT / "tests").rglob("*.py"))
    )


def closure(first: str = "learner.commands.run") -> set[Path]:
    """Modules that one imports, directly or not; plug-ins, which are found by their names, are
    not among them.
    """
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sources()}
    found: set[str] = set()
    left = [first]
    while left:
        name = left.pop()
        if name not in found and name in names:
            found.add(name)
            left += _imported(names[name])
    return {names[name] for name in found}


def upward() -> list[str]:
    """Imports of a package that lies above."""
    below = {"farm": {"workers", "learner"}, "workers": {"learner"}, "learner": {"workers"}}
    return [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources()
        for name in _imported(path)
        if name.partition(".")[0] in below[path.relative_to(ROOT).parts[0]]
    ]


def nouns(folder: str) -> int:
    """Public classes and functions of a folder's modules, without methods."""
    return sum(
        isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
        for path in sorted((ROOT / folder).glob("*.py"))
        for node in ast.parse(path.read_text("utf-8")).body
    )


def between_tools() -> list[str]:
    """Imports of a tool by another one, but for that which simulates a run's policies again."""
    out = []
    for path in sorted((ROOT / "learner/tools").rglob("*.py")):
        for name in _imported(path):
            parts = name.split(".")
            if parts[:2] == ["learner", "tools"] and parts[2:3] not in (
                [path.parent.name],
                ["replay"],
                [],
            ):
                out.append(f"{path.relative_to(ROOT)}: {name}")
    return out


def measured() -> dict[str, tuple[int, int | None]]:
    """By what is counted: how many there are, and the most that is wanted; None: it is only
    printed.
    """
    kernel = closure()
    return {
        "import circles": (len(circles()), 0),
        "upward imports": (len(upward()), 0),
        "imports of a tool by another": (len(between_tools()), 0),
        "tools that a run imports": (len([path for path in kernel if "tools" in path.parts]), 0),
        "variables called by a participle": (participles(), 10),
        "uses of private names in tests": (private_uses(), 40),
        "files that a run imports": (len(kernel), None),
        "lines of them": (lines(kernel), None),
        "classes and functions of the pool": (nouns("learner/pool"), None),
        "files on the way of a perturbation": (len(way("a perturbation").files), None),
        "files on the way of a trace": (len(way("a trace").files), None),
        "public names": (len(farm.__all__), None),
    }


def main() -> int:
    """Print the table; 1 if an aim is missed."""
    missed = 0
    for name, (count, most) in measured().items():
        if most is None:
            sys.stdout.write(f"        {name}: {count}\n")
            continue
        missed += count > most
        sys.stdout.write(
            f"{'ok    ' if count <= most else 'MISSED'}  {name}: {count} (at most {most})\n"
        )
    for line in (*circles(), *upward(), *between_tools()):
        sys.stdout.write(f"        {line}\n")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
