"""`python -m lgmdjax`: the command line."""

import sys

from lgmdjax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
