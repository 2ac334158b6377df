"""The size and shape of the project: `python -m tests.house` prints one line per aim, and fails if one is missed.

The ways of a perturbation and of a trace are counted on docs/architecture.md; `tests/loop/test_ways.py` follows
a run along them.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Final

from tests.shared.ways import way

ROOT: Final = Path(__file__).parent.parent
PACKAGES: Final = ("farm", "workers", "learner")
LONG: Final = 400
"""Lines of a file that are too many for one idea."""


def sources() -> list[Path]:
    """Modules of the three packages."""
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def lines(paths: Iterable[Path]) -> int:
    """Lines of files."""
    return sum(len(path.read_text("utf-8").splitlines()) for path in paths)


def circles() -> list[str]:
    """Import circles, each as its modules; imports within functions count, those for annotations alone do not."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sources()}
    graph = {name: {each for each in _imported(path) if each in names and each != name} for name, path in names.items()}
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
    "asked begun chosen drawn found given gone heard held kept known lost made mine named own read said seen sent "
    "shown taken theirs there told tried used wanted".split()
)


def participles() -> int:
    """Variables and arguments of the packages' functions that are called by a participle or a pronoun."""
    count = 0
    for path in sources():
        for function in (
            node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.FunctionDef)
        ):
            nodes = list(ast.walk(function))
            names = {each.id for each in nodes if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)}
            count += len(PARTICIPLES & (names | {each.arg for each in nodes if isinstance(each, ast.arg)}))
    return count


def private_uses() -> int:
    """Private names that tests use: `thing._name`, also in a string, or imported; but for a test's own `self`."""
    uses = re.compile(r"(?<!\bself)(?<!\bcls)\._(?!_)[A-Za-z]\w*|import _\w+")
    return sum(len(uses.findall(path.read_text("utf-8"))) for path in sorted((ROOT / "tests").rglob("*.py")))


def items(*words: str) -> int:
    """Tests that pytest collects."""
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-m", "", *words]
    output = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return sum("::" in line for line in output.splitlines())


def words() -> int:
    """Words of the pages in docs/, but not of results: neither docs/results/ nor the page that leads there."""
    pages = sorted({*(ROOT / "docs").glob("*.md")} - {ROOT / "docs/results.md"})
    return sum(len(path.read_text("utf-8").split()) for path in pages)


def measured() -> dict[str, tuple[int, int]]:
    """By aim: what is, and the most that is wanted."""
    long = [path for path in sources() if lines([path]) > LONG]
    return {
        "files on the way of a perturbation": (len(way("a perturbation").files), 10),
        "files on the way of a trace": (len(way("a trace").files), 12),
        "import circles": (len(circles()), 0),
        "modules at the root of learner/": (len([*(ROOT / "learner").glob("[!_]*.py")]), 4),
        f"files of the packages over {LONG} lines": (len(long), 0),
        "tests of PGPE": (
            items(*map(str, sorted((ROOT / "tests/unit/learner/algorithms").glob("test_pgpe*.py")))),
            300,
        ),
        "variables called by a participle": (participles(), 10),
        "uses of private names in tests": (private_uses(), 40),
        "words in docs/ without results": (words(), 30_000),
        "lines of the three packages": (lines(sources()), 19_300),
    }


def main() -> int:
    """Print the table; 1 if an aim is missed."""
    table = measured()
    for name, (count, most) in table.items():
        sys.stdout.write(f"{'ok    ' if count <= most else 'MISSED'}  {name}: {count} (at most {most})\n")
    sys.stdout.writelines(f"        {circle}\n" for circle in circles())
    return int(any(count > most for count, most in table.values()))


if __name__ == "__main__":
    sys.exit(main())
