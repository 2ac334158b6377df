"""Runs the cells of a notebook in one plain Python process, without Jupyter, and prints what they
show.

    python plain_notebook.py NOTEBOOK

A kernel with IPython is too large for the packages of the tests. In its place are `display`,
`Image` and the line `%%writefile`: another magic is a syntax error.
"""

import ast
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Self


class Image:
    """A picture in a file."""

    def __init__(self, filename: str) -> None:
        self._head = Path(filename).read_bytes()[:6]

    def __str__(self) -> str:
        return f"Image {self._head!r}"


class Shown:
    """An output that can be replaced."""

    def update(self, value: Any) -> Self:
        sys.stdout.write(f"[updated {value}]\n")
        return self


def display(value: Any, *, display_id: bool = False) -> Shown | None:
    """Show a value below its cell."""
    sys.stdout.write(f"[shown {value}]\n")
    return Shown() if display_id else None


def run(cell: str, names: dict[str, Any]) -> None:
    """Run one cell; the value of its last expression is shown."""
    magic, _, rest = cell.partition("\n")
    if magic.startswith("%%writefile "):
        Path(magic.split()[1]).write_text(rest, "utf-8")
        return
    tree = ast.parse(cell)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    if isinstance(last, ast.Expr):
        value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
        if value is not None:
            display(value)


def main() -> None:
    """Run the notebook that the command line names."""
    shown = ModuleType("IPython.display")
    vars(shown).update(display=display, Image=Image)
    sys.modules["IPython.display"] = shown
    notebook = json.loads(Path(sys.argv[1]).read_text("utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            run("".join(cell["source"]), names)


if __name__ == "__main__":
    main()
