"""`python -m lerobot_ufrnn.commands` is `ufrnn`."""

import sys

from . import main

sys.exit(main())
