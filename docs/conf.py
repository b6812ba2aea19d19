"""Builds the documentation site with Sphinx: `make docs`.

Pages are the Markdown files of the repository, as a forge shows them. While they are read, two things are added: the
navigation, which follows the tables of docs/README.md, and what takes the place of comments such as
`<!-- generated: commands -->` (docs/generate/). Nothing comes from the network: no inventories, fonts or scripts.
"""

import os
import shutil
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from docs.generate import MARK, fill, navigation  # noqa: E402  (found only now)
from docs.generate.python_api import as_rst  # noqa: E402

project = "spadrig"
release = version = installed("spadrig")
copyright = "the authors of spadrig; Apache-2.0"

extensions = ["myst_nb", "sphinx.ext.autodoc"]
# The source folder is the root of the repository, so that links between README.md, CONTRIBUTING.md and docs/ hold.
root_doc = "README"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "docs/**/*.md", "docs/**/*.ipynb"]
include_patterns += ["docs/*.md", "examples/*/README.md"]
exclude_patterns = [".*", "**/.*", "runs", "dist", "docs/_build"]
exclude_patterns += ["calibration", "config", "drivers", "rig", "sim_backend", "tests"]

highlight_language = "none"
myst_heading_anchors = 4
smartquotes = False  # options begin with two hyphens
# A docstring is plain text, in which `this` is code.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

nb_execution_mode = os.environ.get("NOTEBOOKS", "force")  # or off, where tests run them
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

html_theme = "furo"
html_title = "spadrig"
html_copy_source = False
html_show_sourcelink = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]


def _read(app: Any, page: str, source: list[str]) -> None:
    """Put navigation and generated parts into a page that Sphinx has read."""
    if not page.endswith(".ipynb"):
        source[0] = fill(source[0])
    if page == root_doc:
        source[0] += navigation((ROOT / "docs" / "README.md").read_text())


def _outdated(app: Any, env: Any, *changes: set[str]) -> list[str]:
    """Pages that are read again in every build, since they also depend on the program: generated ones and notebooks."""
    texts = {page: Path(env.doc2path(page)) for page in env.found_docs}
    return [page for page, file in texts.items() if page == root_doc or file.suffix == ".ipynb" or _is_generated(file)]


def _is_generated(page: Path) -> bool:
    return MARK.search(page.read_text(encoding="utf-8")) is not None


def _tell(app: Any, what: str, name: str, of: object, options: object, lines: list[str]) -> None:
    """Rewrite a docstring for docutils."""
    lines[:] = as_rst(lines)


def _finish(app: Any, error: Exception | None) -> None:
    """Make the first page the one that a browser opens."""
    if error is None and app.builder.format == "html":
        shutil.copy(Path(app.outdir) / f"{root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx: where the program takes part in its work."""
    app.connect("source-read", _read)
    app.connect("env-get-outdated", _outdated)
    app.connect("autodoc-process-docstring", _tell)
    app.connect("build-finished", _finish)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
