"""What is put into pages while the site is built: navigation, and references made of the program itself.

A page says where a generated part goes by a comment, which a forge does not show: `<!-- generated: commands -->`.
"""

import re
from collections.abc import Callable, Mapping

from docs.generate import commands, config_keys, python_api

GENERATORS: Mapping[str, Callable[[], str]] = {
    "commands": commands.page,
    "config keys": config_keys.page,
    "python api": python_api.page,
}
"""Makers of Markdown by the name that a page's comment gives."""
MARK = re.compile(r"^<!-- generated: ([a-z ]+) -->$", re.M)
_SECTION = re.compile(r"^## (.+)\n((?:(?!^## ).*\n)+)", re.M)
_PAGE = re.compile(r"\]\(([\w./-]+)\.(?:md|ipynb)\)")


def fill(text: str) -> str:
    """The Markdown of a page with its generated parts in place. Raises KeyError for a name that no generator has."""
    return MARK.sub(lambda mark: GENERATORS[mark[1]](), text)


def sections(index: str) -> dict[str, list[str]]:
    """Pages by heading of docs/README.md, relative to docs/ and without suffix, each where it comes first."""
    found: dict[str, list[str]] = {}
    listed: set[str] = set()
    for heading, body in _SECTION.findall(index):
        pages = [page for page in dict.fromkeys(_PAGE.findall(body)) if page not in listed]
        listed |= set(pages)
        if pages:
            found[heading] = pages
    return found


def navigation(index: str) -> str:
    """The site's navigation as hidden directives, made of docs/README.md."""
    parts = ["\n\n```{toctree}\n:hidden:\n\ndocs/README\n```\n"]
    for heading, pages in sections(index).items():
        entries = "\n".join(f"docs/{page}".replace("docs/../", "") for page in pages)
        parts.append(f"\n```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{entries}\n```\n")
    return "".join(parts)
