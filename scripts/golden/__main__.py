"""The command `python -m scripts.golden`."""

import sys

from scripts.golden.cli import main

sys.exit(main(sys.argv[1:]))
