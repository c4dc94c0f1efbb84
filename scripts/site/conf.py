"""The documentation site: `make docs`. Builds without the network, and its pages need none; warnings are errors."""

import importlib.util
import os
import sys
from importlib.metadata import version as version_of
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
sys.path[:0] = [str(Path(__file__).parent), str(ROOT)]

from benchmarks.runner.results_page import write_pages  # noqa: E402
from unrender.backend import variant  # noqa: E402

variant.use(os.environ.get("UNRENDER_VARIANT", variant.LLVM))  # some public classes are Mitsuba's own subclasses

import site_pages  # noqa: E402

write_pages(DOCS / "benchmarks")
site_pages.write_pages(DOCS)

project = "unrender"
author = "the unrender contributors"
release = version_of("unrender")
copyright = "unrender contributors, BSD-3-Clause"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "markdown_docstrings", "mathml"]
exclude_patterns = ["_build"]

# Pages: Markdown; those with {code-cell} are notebooks, executed at each build.
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_execution_in_temp = True

# Reference: the names that a module's `__all__` lists, in the order of the page.
autodoc_mock_imports = (
    [] if importlib.util.find_spec("torch") else ["torch"]
)  # an optional dependency of `unrender.grey_box`
autodoc_member_order = "groupwise"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
autodoc_default_options = {"exclude-members": "__init__, __new__, __weakref__, __dict__, __module__"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
add_module_names = False


def setup(app):
    """Add links to benchmarks and to notebooks."""
    app.connect("source-read", site_pages.offer_notebook)
    app.connect("source-read", site_pages.link_benchmarks)


html_theme = "furo"
html_title = "unrender"
html_static_path = ["static"]
html_css_files = ["unrender.css"]
smartquotes_action = "qe"  # not "--", which begins options
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "light_css_variables": {"font-stack": "system-ui, sans-serif"},
    "dark_css_variables": {"font-stack": "system-ui, sans-serif"},
}
