"""HTML pages of run folders: the page of one run (`page`), and the comparison of several methods at equal time (`compare`)."""

from unrender.app.report.pages import compare, load_comparison, page, write_comparison

__all__ = ["compare", "load_comparison", "page", "write_comparison"]
