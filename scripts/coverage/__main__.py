"""The command `python -m scripts.coverage`."""

import sys

from scripts.coverage.cli import main

sys.exit(main(sys.argv[1:]))
