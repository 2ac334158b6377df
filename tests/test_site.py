"""The site shows all pages and public names; the examples of their descriptions run."""

import importlib.util
import inspect
import json
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import farm

ROOT = Path(__file__).parent.parent


def hook(name: str) -> ModuleType:
    """A module of docs/, which mkdocs loads by its path."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", ROOT / f"docs/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PAGES = hook("pages")
NOTEBOOKS = hook("notebooks")


def test_each_page_is_in_the_navigation() -> None:
    groups = PAGES.navigation((ROOT / "docs/README.md").read_text("utf-8"))
    entries = [page for group in groups for pages in group.values() for page in pages]
    assert {f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")} - {
        "docs/README.md"
    } <= set(entries)
    assert {"examples/README.md", "examples/first_steps.md"} <= set(entries)
    assert "Start here" in groups[0]


@pytest.mark.parametrize(
    ("link", "led"),
    [
        ("[a](method.md#sources)", "[a](method.md#sources)"),
        ("[a](../farm/seeds.py)", "[a](https://x.example/y/blob/HEAD/farm/seeds.py)"),
        ("[a](../examples)", "[a](https://x.example/y/blob/HEAD/examples)"),
        ("[a](https://mujoco.org)", "[a](https://mujoco.org)"),
        ("![a](pictures/hand.png)", "![a](pictures/hand.png)"),
        ("values[i](nothing)", "values[i](nothing)"),
    ],
)
def test_a_link_to_a_file_that_is_no_page_leads_to_the_repository(link: str, led: str) -> None:
    assert PAGES.relinked(link, "docs/task.md", {"docs/method.md"}, "https://x.example/y/") == led


def test_without_an_address_of_the_repository_such_a_link_is_text() -> None:
    assert PAGES.relinked("see [a](../farm/seeds.py).", "docs/task.md", set(), "") == "see a."


def test_a_notebook_is_a_page_of_its_text_and_code() -> None:
    cells = [
        {"cell_type": "markdown", "source": ["# Steps\n", "Read [it](../docs/api.md)."]},
        {"cell_type": "code", "source": ["import farm\n", "farm.learn"], "outputs": []},
    ]
    made = NOTEBOOKS.page(json.dumps({"cells": cells}))
    assert made == (
        "# Steps\nRead [it](../docs/api.md).\n\n```python\nimport farm\nfarm.learn\n```\n"
    )


@pytest.mark.parametrize(
    ("link", "led"),
    [
        ("[a](../examples/b.ipynb)", "[a](../examples/b.md)"),
        ("[`b.ipynb`](b.ipynb#learn)", "[`b.ipynb`](b.md#learn)"),
        ("[a](b.md), `jupyter lab b.ipynb`", "[a](b.md), `jupyter lab b.ipynb`"),
        ("[a](https://x.example/b.ipynb)", "[a](https://x.example/b.ipynb)"),
    ],
)
def test_a_link_to_a_notebook_leads_to_its_page(link: str, led: str) -> None:
    assert NOTEBOOKS.on_page_markdown(link) == led


def test_the_reference_has_the_public_names() -> None:
    page = (ROOT / "docs/api.md").read_text("utf-8")
    assert sorted(re.findall(r"^`farm\.(\w+)`$", page, re.M)) == sorted(
        set(farm.__all__) - {"__version__"}
    )


@pytest.mark.parametrize(
    ("name", "where"), [("Farm", "learner.farm"), ("SearchState", "learner.algorithms.state")]
)
def test_the_reference_finds_a_name_where_it_is_defined(name: str, where: str) -> None:
    assert f"::: {where}.{name}\n" in PAGES.located(f"# Reference\n\n`farm.{name}`\n")


def example(name: str) -> str:
    """The program in a public name's description; empty if there is none."""
    described = inspect.getdoc(getattr(farm, name)) or ""
    [program] = re.findall(r"^Example:\n  ```python\n(.*?)^  ```$", described, re.S | re.M) or [""]
    return textwrap.dedent(program)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder where the example of `farm.learn` has run: others look at its run."""
    folder = tmp_path_factory.mktemp("examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(example("learn"), "farm.learn", "exec"), {"__name__": "example"})
        yield folder


APART = {"__version__", "learn", "sweep", "tune"}
"""Without an example, or with one that runs otherwise."""
ERRORS = {"ConfigError", "CheckpointError", "RunError", "TaskError"}
"""Their example is that of FarmError."""


SLOW = {"Farm"}
"""Its example is a script of its own workers, as those of tests/loop/test_pool.py."""


def shown() -> list[Any]:
    """Public names whose examples run, as parameters."""
    names = [each for each in farm.__all__ if each not in APART | ERRORS]
    return [pytest.param(each, marks=pytest.mark.slow if each in SLOW else ()) for each in names]


@pytest.mark.parametrize("name", shown())
def test_the_example_of_a_public_name_runs(name: str, place: Path) -> None:
    program = example(name)
    assert f"farm.{name}" in program or name in {"Backend", "Algorithm", "Record", "FarmError"}
    exec(compile(program, f"farm.{name}", "exec"), {"__name__": "example"})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "printed"),
    [("tune", "tunes/gait/"), ("sweep", "[('1', 'finished'), ('2', 'finished')]")],
)
def test_an_example_with_learners_of_its_own_runs(place: Path, name: str, printed: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", example(name)],
        cwd=place,
        check=True,
        capture_output=True,
        text=True,
    )
    assert printed in done.stdout
