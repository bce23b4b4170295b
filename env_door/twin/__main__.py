"""`python -m env_door.twin --address=127.0.0.2 --kind=random --seed=0` runs until Ctrl-C or SIGTERM."""

import asyncio
import contextlib
import logging
import selectors
import signal
import sys

import draccus
from draccus.utils import ParsingError

from env_door.twin.client import READY
from env_door.twin.server import Twin, TwinConfig

logger = logging.getLogger("env_door.twin")


async def main() -> None:
    """Runs a twin until it is told to stop."""
    try:
        config = draccus.parse(TwinConfig)
        twin = Twin(config)
        await twin.open()
    except (ParsingError, ValueError, OSError, ModuleNotFoundError, RuntimeError) as error:
        sys.exit(f"env_door.twin: {error.__cause__ or error}")  # draccus wraps what the configuration says
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, twin.stopped.set)
    if config.until_stdin_closes:
        loop.add_reader(sys.stdin, twin.stopped.set)
    logger.info("listening on %s", config.address)
    print(READY, flush=True)
    with contextlib.closing(twin):
        await twin.run()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # Unlike the default one, this selector does not wait in whole milliseconds: ticks come in time.
    asyncio.run(main(), loop_factory=lambda: asyncio.SelectorEventLoop(selectors.SelectSelector()))
