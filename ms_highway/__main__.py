"""``python -m ms_highway`` is the command ``ms-highway``."""

import sys

from ms_highway.cli.main import main

sys.exit(main())
