"""What to train: a configuration file for `lerobot-train`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml


@dataclass(frozen=True)
class Model:
    """A configuration file for `lerobot-train`.

    Attributes:
        name (`str`): name of the file without its ending.
        text (`str`): the file as it was when the protocol began.
        settings (`dict[str, Any]`): what it states.
    """

    name: str
    text: str
    settings: dict[str, Any]

    @classmethod
    def read(cls, path: Path) -> "Model":
        """Reads a model's file.

        Args:
            path (`Path`):
                YAML or JSON.

        Returns:
            `Model`: the model.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it lacks what the protocol needs to know, or chooses demonstrations of its own.
        """
        if not path.is_file():
            raise FileNotFoundError(
                f"--models: there is no file '{path}'; give configuration files such as configs/ufrnn_paper.yaml."
            )
        text = path.read_text()
        try:
            settings = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(f"{path} is not YAML: {error}") from error
        policy = settings.get("policy") if isinstance(settings, dict) else None
        if not isinstance(policy, dict) or not isinstance(policy.get("type"), str):
            raise ValueError(f"{path} must state `policy.type`, such as `ufrnn`, `act` or `diffusion`.")
        for name in ("batch_size", "steps"):
            value = settings.get(name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{path} must state `{name}`, a whole number of at least 1, got {value!r}.")
        own = [name for name in ("episodes", "eval_split") if (settings.get("dataset") or {}).get(name)]
        if own:
            raise ValueError(
                f"{path} states `dataset.{own[0]}`, but all models learn from the same demonstrations: remove it."
            )
        return cls(path.stem, text, settings)
