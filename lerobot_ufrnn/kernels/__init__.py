"""Fast CPU kernel: the same numbers as `foresight.py` and `networks/sh_lstm.py`, compiled.

From the inside out: `forward` goes through whole episodes with foresight and `backward` back again for the gradients,
`layout` names what they pass to each other and lays the weights out for them, and `unroll` offers it all behind the
signature of [`UFRNN`]. Products are BLAS calls, of as few and as large matrices as possible.
"""

import logging
from typing import TYPE_CHECKING

from ..foresight import UFRNN

if TYPE_CHECKING:
    from ..configuration_ufrnn import UFRNNConfig

logger = logging.getLogger(__name__)


def make_model(config: "UFRNNConfig") -> UFRNN:
    """The recurrent model, compiled where that is asked for and can be had."""
    if config.kernel == "reference":
        return UFRNN(config)
    try:
        from .unroll import FastUFRNN, unsupported
    except ImportError as error:
        if config.kernel == "fast":
            raise ImportError(
                f"`kernel=fast` needs Numba, which cannot be imported here ({error}). Install it (`pip install numba`) "
                "or take --policy.kernel=reference."
            ) from error
        logger.warning("Numba cannot be imported (%s): taking the reference kernel, about ten times slower.", error)
        return UFRNN(config)
    reason = unsupported(config)
    if reason is None:
        return FastUFRNN(config)
    if config.kernel == "fast":
        raise ValueError(f"`kernel=fast` does not compile {reason}; take --policy.kernel=auto or reference.")
    logger.info("The compiled kernel does not have %s: taking the reference kernel, about ten times slower.", reason)
    return UFRNN(config)
