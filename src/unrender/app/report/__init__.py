"""HTML pages of run folders: the page of one run (`page`), and the comparison of several methods at equal time (`compare`)."""

from unrender.app.report.comparison import compare, load_comparison, write_comparison
from unrender.app.report.page import page

__all__ = ["compare", "load_comparison", "page", "write_comparison"]
