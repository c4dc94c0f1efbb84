"""The application around the library: command line, pages, captures, exports, sweeps, distributed runs."""

from typing import TYPE_CHECKING

from unrender.core import lazy

if TYPE_CHECKING:
    from unrender.app.capture.importing import ImportOptions, import_capture
    from unrender.app.cli.sweep import sweep
    from unrender.app.distributed.distribute import distribute
    from unrender.app.evaluation.judge import judge
    from unrender.app.evaluation.turntable import turntable
    from unrender.app.exporting.scene_folder import export

__getattr__ = lazy.attach(
    __name__,
    {
        "ImportOptions": "capture.importing",
        "distribute": "distributed.distribute",
        "export": "exporting.scene_folder",
        "import_capture": "capture.importing",
        "judge": "evaluation.judge",
        "sweep": "cli.sweep",
        "turntable": "evaluation.turntable",
    },
)
__all__ = ["ImportOptions", "distribute", "export", "import_capture", "judge", "sweep", "turntable"]
