"""Tell the operator something once, not at every step."""

import logging

SILENCE_SECONDS = 2.0
"""Time that a condition must have been over before it is told again."""


class Notices:
    """Conditions that were told, and when they last held.

    Args:
        logger (`logging.Logger`):
            Gets the warnings.
    """

    def __init__(self, logger: logging.Logger):
        self._logger = logger
        self._seen: dict[str, float] = {}

    def tell(self, message: str, now: float, kind: str | None = None) -> None:
        """Tells of a condition that holds now, unless it has held until now.

        Args:
            message (`str`):
                What to tell.
            now (`float`):
                Time in seconds.
            kind (`str | None`, *optional*):
                What counts as the same condition; the message unless given.
        """
        kind = kind or message
        before = self._seen.get(kind)
        self._seen[kind] = now
        if before is None or now - before > SILENCE_SECONDS:
            self._logger.warning(message)
