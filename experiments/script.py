"""How the experiments are started: a function with the flags of a command line."""

import sys
from collections.abc import Callable
from pathlib import Path

from draccus.utils import ParsingError

from lerobot_ufrnn.commands import parse_flags


def run[Config](main: Callable[[Config], None], config_class: type[Config], arguments: list[str] | None = None) -> None:
    """Runs a script with the flags of its command line; what is wrong is said without a traceback."""
    name = Path(sys.argv[0]).name
    try:
        words = sys.argv[1:] if arguments is None else arguments
        main(parse_flags(config_class, words, f"python experiments/{name}"))
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        sys.exit(130)
    except (ValueError, OSError, RuntimeError, ParsingError) as error:
        sys.exit(f"{name}: {error}")
