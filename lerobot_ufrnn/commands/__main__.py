"""`python -m lerobot_ufrnn.commands` is `ufrnn`."""

from . import main

raise SystemExit(main())
