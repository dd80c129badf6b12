"""`python -m sonotwin`, the same as the command `sonotwin`."""

import sys

from sonotwin.cli import main

sys.exit(main())
