"""Pages for people, made from run folders on disk: one run (`page`), or several methods at equal time (`compare`)."""

from unrender.report.comparison import compare
from unrender.report.page import page

__all__ = ["compare", "page"]
