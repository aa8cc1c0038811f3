"""python -m mpfjax: see `mpfjax.command`."""

import sys

from mpfjax.command import main

if __name__ == "__main__":
    sys.exit(main())
