"""``python -m grmm`` runs the ``grmm`` command."""

import sys

from grmm.cli import main

sys.exit(main())
