"""``python -m express50``: the ``express50`` command."""

import sys

from express50.cli import main

sys.exit(main())
