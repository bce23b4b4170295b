"""UF-RNN for LeRobot: a recurrent policy that imagines its futures and explores where it is uncertain.

The public names; each is imported when it is first used, as PyTorch and LeRobot take seconds and half a gigabyte.
"""

from importlib import import_module
from typing import Any

_MODULES = {
    "configuration_ufrnn": (
        "UFRNNConfig",
        "ForesightConfig",
        "RecallConfig",
        "AutoencoderConfig",
        "AugmentationConfig",
    ),
    "modeling_ufrnn": ("UFRNNPolicy",),
    "processor_ufrnn": ("make_ufrnn_pre_post_processors",),
    "networks": ("SHLSTM", "HiddenState", "Prediction"),
    "foresight": ("UFRNN", "Foresight", "ForesightTrace", "perturb", "roll_out", "select"),
    "demonstrations": ("Demonstrations",),
    "recall": ("Recall", "RecallEvent"),
}

__all__ = [name for names in _MODULES.values() for name in names]


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
