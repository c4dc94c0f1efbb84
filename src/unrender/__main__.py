"""`python -m unrender`."""

import sys

from unrender.app.cli.main import main

sys.exit(main())
