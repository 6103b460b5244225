"""The command `avmsf`, as `python -m avmsf`."""

import sys

from avmsf.cli import main

sys.exit(main())
