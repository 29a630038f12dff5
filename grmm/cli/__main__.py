"""``python -m grmm.cli``."""

import sys

from grmm.cli import main

sys.exit(main())
