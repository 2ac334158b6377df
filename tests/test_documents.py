"""Documents quote the program correctly."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from farm.flags import SHORT

ROOT = Path(__file__).parent.parent
SOURCE = "\n".join(
    path.read_text("utf-8")
    for name in ("farm", "learner", "workers")
    for path in (ROOT / name).rglob("*.py")
)
SAID = re.sub(r'"\s*\n\s*f?"', "", SOURCE)
"""With strings put together that stand on several lines."""


def quoted() -> list[str]:
    lines = (ROOT / "docs/troubleshooting.md").read_text("utf-8").splitlines()
    return [
        part
        for line in lines
        if line.startswith("| `")
        for part in re.findall(r"`([^`]+)`", line.split(" | ")[0])
    ]


@pytest.mark.parametrize("message", quoted())
def test_messages_that_are_explained_exist(message: str) -> None:
    assert message in SAID


def test_the_table_of_short_forms_is_the_programs() -> None:
    page = (ROOT / "docs/commands.md").read_text("utf-8")
    assert dict(re.findall(r"^\| `(-\w)` \| `--([\w-]+)` \|$", page, re.MULTILINE)) == {
        short: name for name, short in SHORT.items()
    }


WRITTEN = [
    *ROOT.glob("*.md"),
    *(
        path
        for f in (".github", "docs", "examples", "benchmarks", "assets")
        for path in (ROOT / f).rglob("*.md")
    ),
    *(ROOT / "examples").glob("*.ipynb"),
]


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """Each relative link of a page leads to a file, and its anchor to a heading there."""
    for target, anchor in re.findall(r"\]\(([^)#:]*)#?([^):]*)\)", page.read_text("utf-8")):
        path = page.parent / target if target else page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path.read_text("utf-8")), f"{target}#{anchor}"


@pytest.mark.parametrize(
    "page", [page for page in WRITTEN if page.name != "CHANGELOG.md"], ids=lambda page: page.name
)
def test_tests_that_pages_name_exist(page: Path) -> None:
    names = {path.name for path in (ROOT / "tests").rglob("*.py")}
    assert set(re.findall(r"\btest_\w+\.py\b", page.read_text("utf-8"))) <= names


def anchors(text: str) -> set[str]:
    """The addresses of a page's headings, as GitHub makes them."""
    headings = [line.lstrip("#").strip() for line in text.splitlines() if line.startswith("#")]
    return {re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings}


SCRIPTS = "\n".join(
    path.read_text("utf-8")
    for name in ("benchmarks", "docs")
    for path in (ROOT / name).rglob("*.py")
)
FLAGS = {name.replace("_", "-") for name in re.findall(r"^    (\w+): .*$", SOURCE, re.M)}
FLAGS |= set(re.findall(r'"--([a-z-]+)"', SCRIPTS)) | {
    "help",
    "help-all",
    "version",
    "measurements",
}
FLAGS |= set(re.findall(r"arg\(name=\"([a-z-]+)\"", SOURCE))
FLAGS |= {"dropped", "ended", "fell", "torque", "goals", "elite"}
"""Of commands, of scripts and tests, and those that tasks and algorithms of the pages bring."""

PAGES = [page for folder in (".", "docs", "examples") for page in (ROOT / folder).glob("*.md")]


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name
)
def test_flags_that_pages_name_exist(page: Path) -> None:
    """Those in commands `farm ...`, in lines of code or in the text, and those that the text names
    alone.
    """
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.S | re.M)
    spans = re.findall(r"`((?:farm |--)[^`]*)`", text) + re.findall(
        r"^    (?:\S*/)?(farm .*)$", text, re.M
    )
    flags = {flag for part in spans for flag in re.findall(r"(?<![\w-])--([a-z][a-z_-]*)", part)}
    flags = {flag.replace("_", "-") for flag in flags}
    assert {flag for flag in flags if flag.removeprefix("no-") not in FLAGS} == set()


def test_the_task_in_the_readme_is_the_one_that_new_task_writes() -> None:
    [program] = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    assert parts(program) == parts(
        (ROOT / "learner/tools/tasks/task_template.py.txt").read_text("utf-8")
    )


def test_the_task_in_the_notebook_is_the_one_that_new_task_writes() -> None:
    notebook = json.loads((ROOT / "examples/first_steps.ipynb").read_text("utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"]]
    [program] = [cell for cell in cells if cell.startswith("%%writefile pendulum.py\n")]
    assert parts(program.partition("\n")[2]) == parts(
        (ROOT / "learner/tools/tasks/task_template.py.txt").read_text("utf-8")
    )


def test_the_pendulum_of_the_examples_is_the_one_that_new_task_writes() -> None:
    template = ROOT / "learner/tools/tasks/task_template.py.txt"
    example = ROOT / "examples/tasks/pendulum.py"
    assert example.read_text("utf-8") == template.read_text("utf-8")


def parts(source: str) -> list[str]:
    """The statements of a task's class, without its docstring, comments, or spaces between XML
    elements.
    """
    [task] = [node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)]
    body = [node for node in task.body if not isinstance(node, ast.Expr)]
    return [re.sub(r">(\\n|\s)*<", "><", ast.dump(node)) for node in body]


@pytest.mark.slow
def test_the_pages_of_results_are_what_the_recorded_data_says(tmp_path: Path) -> None:
    """Pages and figures made from a copy of docs/results are those of the project."""
    pytest.importorskip("matplotlib")
    docs = ROOT / "docs"
    shutil.copytree(docs / "results", tmp_path / "results")
    shutil.copy(docs / "results.py", tmp_path)
    for copy in (tmp_path / "results").glob("*.svg"):
        copy.unlink()
    for copy in (tmp_path / "results").glob("*.md"):
        os.utime(copy, (0, 0))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # benchmarks/ is in the checkout alone
    subprocess.run(
        [sys.executable, tmp_path / "results.py", tmp_path / "results"], env=environment, check=True
    )
    pages = [
        page.relative_to(tmp_path) for page in tmp_path.rglob("*.md") if page.stat().st_mtime > 0
    ]
    assert {Path("results.md"), Path("results/chain.md"), Path("results/future-work.md")} < set(
        pages
    )
    for page in pages:
        assert (tmp_path / page).read_text("utf-8") == (docs / page).read_text("utf-8"), page
    assert len((docs / "results.md").read_text("utf-8").splitlines()) <= 120
    assert {f.name for f in (tmp_path / "results").glob("*.svg")} == {
        f.name for f in (docs / "results").glob("*.svg")
    }
