"""``python -m sfmapp`` is the command ``sfmapp``."""

import sys

from sfmapp.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
