"""`python -m unrender`."""

import sys

from unrender.cli.main import main

sys.exit(main())
