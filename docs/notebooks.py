"""Notebooks of the examples as pages of the site: their text, and their code without outputs."""

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
NOTEBOOK = re.compile(r"(\]\([^):]+)\.ipynb(?=[)#])")


def on_files(files: Any, config: Any) -> Any:  # noqa: ANN401  of mkdocs
    """The site's files, with a page for each notebook."""
    from mkdocs.structure.files import File  # only the site needs it

    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        name = path.relative_to(ROOT).with_suffix(".md").as_posix()
        files.append(File.generated(config, name, content=page(path.read_text("utf-8"))))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:  # noqa: ANN401  of mkdocs
    """A page whose links to notebooks lead to their pages."""
    return NOTEBOOK.sub(r"\1.md", markdown)


def page(notebook: str) -> str:
    """A notebook's cells as Markdown."""
    parts = []
    for cell in json.loads(notebook)["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
    return "\n\n".join(parts) + "\n"
