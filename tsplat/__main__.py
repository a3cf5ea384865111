"""`python -m tsplat`: the command line."""

import sys

from tsplat.cli import main

sys.exit(main())
