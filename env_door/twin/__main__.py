"""`python -m env_door.twin --address=127.0.0.2 --kind=random --seed=0` runs until Ctrl-C or SIGTERM."""

import asyncio
import contextlib
import logging
import os
import selectors
import signal
import sys

import draccus
from draccus.utils import ParsingError

from env_door.twin.client import READY
from env_door.twin.configuration import TwinConfig
from env_door.twin.server import Twin

logger = logging.getLogger("env_door.twin")


async def run(config: TwinConfig) -> None:
    """Runs a twin until it is told to stop."""
    loop = asyncio.get_running_loop()
    with contextlib.closing(Twin(config)) as twin:

        def stop_at_end_of_input() -> None:
            if not os.read(sys.stdin.fileno(), 4096):
                twin.stopped.set()

        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, twin.stopped.set)
        if config.until_stdin_closes:
            loop.add_reader(sys.stdin.fileno(), stop_at_end_of_input)
        await twin.open()
        logger.info("listening on %s; %s", config.address, twin.controller.describe())
        print(READY, flush=True)
        await twin.run()


def main() -> None:
    """Runs the command."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # The default selector waits in whole milliseconds; ticks of 2 ms would come up to 1 ms late.
    make_loop = lambda: asyncio.SelectorEventLoop(selectors.SelectSelector())  # noqa: E731
    try:
        asyncio.run(run(draccus.parse(TwinConfig)), loop_factory=make_loop)
    except (ParsingError, ValueError, OSError, ModuleNotFoundError, RuntimeError) as error:
        wrapped = (
            error.__cause__ if isinstance(error, ParsingError) else None
        )  # draccus wraps what the configuration says
        sys.exit(f"env_door.twin: {wrapped or error}")


if __name__ == "__main__":
    main()
