"""Pages for people, made from run folders on disk: one run (`page`), or several methods at equal time (`compare`)."""

from unrender.report.comparison import compare, examine, publish
from unrender.report.page import page

__all__ = ["compare", "examine", "page", "publish"]
