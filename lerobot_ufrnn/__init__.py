"""UF-RNN for LeRobot: a recurrent policy that imagines its futures and explores where it is uncertain."""

from .configuration_ufrnn import UFRNNConfig

__all__ = ["UFRNNConfig"]
