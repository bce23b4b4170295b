"""UF-RNN for LeRobot: a recurrent policy that imagines its futures and explores where it is uncertain."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .configuration_ufrnn import UFRNNConfig

__all__ = ["UFRNNConfig"]


def __getattr__(name: str) -> Any:
    # On demand: LeRobot and PyTorch take seconds and half a gigabyte, which a command that only starts others spares.
    if name == "UFRNNConfig":
        from .configuration_ufrnn import UFRNNConfig

        return UFRNNConfig
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
