"""``python -m grmm``: the ``grmm`` command."""

import sys

from grmm.cli import main

sys.exit(main())
