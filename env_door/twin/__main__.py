"""`python -m env_door.twin --address=127.0.0.2 --kind=random --seed=0` runs until Ctrl-C or SIGTERM."""

import logging
import signal
import sys

import draccus
from draccus.utils import ParsingError

from env_door.twin.configuration import TwinConfig
from env_door.twin.process import READY
from env_door.twin.twin import Twin

logger = logging.getLogger("env_door.twin")


def main() -> None:
    """Runs a twin."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        config = draccus.parse(TwinConfig)
        twin = Twin(config)
    except ParsingError as error:
        # Draccus wraps what the configuration says.
        sys.exit(f"env_door.twin: {error.__cause__ or error}")
    except (ValueError, OSError, ModuleNotFoundError, RuntimeError) as error:
        sys.exit(f"env_door.twin: {error}")

    def stop(*_: object) -> None:
        twin.stopping = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    if config.until_stdin_closes:
        twin.hub.watch_end(sys.stdin.fileno(), stop)
    logger.info("listening on %s; %s", config.address, twin.controller.describe())
    print(READY, flush=True)
    try:
        twin.run()
    finally:
        twin.close()


if __name__ == "__main__":
    main()
