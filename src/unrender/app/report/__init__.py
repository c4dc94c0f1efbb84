"""Pages for people, made from run folders on disk: one run (`page`), or several methods at equal time (`compare`)."""

from unrender.app.report.comparison import compare, load_comparison, write_comparison
from unrender.app.report.page import page

__all__ = ["compare", "load_comparison", "page", "write_comparison"]
