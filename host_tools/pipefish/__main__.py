"""`python -m pipefish` is `pipefish`."""

import sys

from pipefish.cli import main

if __name__ == "__main__":
    sys.exit(main())
