"""`python -m unrender`."""

import sys

from unrender.cli.entry import main

sys.exit(main())
