"""``python -m express50`` runs the ``express50`` command."""

import sys

from express50.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
