"""What the site needs beside mkdocs.yml: pages outside docs/, links to other files, navigation, the
public names.
"""

import importlib
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).parent.parent
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!\w+:|#)([^)#\s]+)(#[^)]*)?\)")


def on_config(config: Any) -> None:  # noqa: ANN401  of mkdocs
    """The pages are those of the whole repository; headings have the addresses that GitHub gives
    them.
    """
    from pymdownx.slugs import slugify  # only the site needs it

    config.docs_dir = str(ROOT)
    index = (ROOT / "docs/README.md").read_text("utf-8")
    config.nav = ["README.md", {"All pages": "docs/README.md"}, *navigation(index)]
    config.mdx_configs["toc"] = {"slugify": slugify(case="lower"), "permalink": True}


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:  # noqa: ANN401  of mkdocs
    """A page as the site needs it."""
    pages = {file.src_uri for file in files if file.inclusion.is_included()}
    text = relinked(markdown, page.file.src_uri, pages, config.repo_url or "")
    return located(text) if page.file.src_uri == "docs/api.md" else text


def navigation(index: str) -> list[dict[str, list[str]]]:
    """The pages that the tables of docs/README.md link, by the headings above them; a notebook has a
    page as well.
    """
    groups = re.findall(r"^## (.+)\n\n((?:\|.*\n)+)", index, re.M)
    linked = {name: re.findall(r"^\| \[[^\]]*\]\(([^)]+)\)", table, re.M) for name, table in groups}
    return [
        {name: [normal("docs", page.replace(".ipynb", ".md")) for page in pages]}
        for name, pages in linked.items()
        if pages
    ]


def relinked(markdown: str, page: str, pages: set[str], repository: str) -> str:
    """The page with its links to files that are not on the site leading to the repository, or being
    plain text.
    """

    def lead(link: re.Match[str]) -> str:
        text, target, anchor = link.groups()
        path = normal(str(PurePosixPath(page).parent), target)
        # What is nowhere is reported by mkdocs, and code is no link
        if path in pages or not (ROOT / path).exists():
            return link[0]
        return (
            f"[{text}]({repository.rstrip('/')}/blob/HEAD/{path}{anchor or ''})"
            if repository
            else text
        )

    return LINK.sub(lead, markdown)


def located(markdown: str) -> str:
    """The reference, with a directive for each line `farm.NAME`.

    It names the module that defines it: `farm` loads its names lazily.
    """
    return re.sub(r"^`farm\.(\w+)`$", _directive, markdown, flags=re.M)


def _directive(name: re.Match[str]) -> str:
    where = getattr(importlib.import_module("farm"), name[1]).__module__
    return (
        f"\n::: {where}.{name[1]}\n    options:\n      heading: farm.{name[1]}\n      toc_label:"
        f" {name[1]}\n"
    )


def normal(folder: str, target: str) -> str:
    """A link's target from the top of the repository."""
    return os.path.normpath(f"{folder}/{target}")
