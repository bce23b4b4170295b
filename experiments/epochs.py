"""A configuration file for `lerobot-train`, and which of its updates ends which epoch."""

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import yaml

AUTOENCODER_STEPS = 400
"""Default of `policy.autoencoder.steps`, stated here because the configuration imports PyTorch."""

MAX_CHECKPOINTS = 200


class Model(NamedTuple):
    """A configuration file for `lerobot-train`, as it was when the sweep began."""

    name: str
    text: str
    settings: dict[str, Any]


def read_model(path: Path) -> Model:
    """Reads a model's file; refuses one that lacks what must be known, or chooses demonstrations of its own."""
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
    return Model(path.stem, text, settings)


class Schedule(NamedTuple):
    """Updates of a training.

    An epoch is a pass of LeRobot's data loader, whose items are episodes for `ufrnn` and frames for other policies; for
    `ufrnn` the updates of the autoencoder come first and belong to no epoch.
    """

    autoencoder_steps: int
    epoch_steps: int
    steps: int

    @classmethod
    def of(cls, settings: dict[str, Any], num_episodes: int, num_frames: int) -> "Schedule":
        """The schedule of a configuration file; a ValueError if `steps` does not end with an epoch."""
        policy, steps = settings["policy"], settings["steps"]
        items, autoencoder_steps = num_frames, 0
        if policy["type"] == "ufrnn":
            items, autoencoder = num_episodes, policy.get("autoencoder") or {}
            autoencoder_steps = 0 if autoencoder.get("path") else autoencoder.get("steps", AUTOENCODER_STEPS)
        epoch_steps = math.ceil(items / settings["batch_size"])
        epochs = (steps - autoencoder_steps) / epoch_steps
        if epochs < 1 or epochs % 1:
            fitting = autoencoder_steps + max(1, round(epochs)) * epoch_steps
            raise ValueError(
                f"`steps` must be {autoencoder_steps} updates of the autoencoder and a multiple of the {epoch_steps} "
                f"of an epoch, such as {fitting}; got {steps}."
            )
        return cls(autoencoder_steps, epoch_steps, steps)

    @property
    def last_epoch(self) -> int:
        """Number of epochs."""
        return (self.steps - self.autoencoder_steps) // self.epoch_steps

    def step_of(self, epoch: int) -> int:
        """The update that ends an epoch, counted from 1."""
        if not 1 <= epoch <= self.last_epoch:
            raise ValueError(
                f"--epochs must be from 1 to {self.last_epoch}, where `steps` = {self.steps} ends, got {epoch}."
            )
        return self.autoencoder_steps + epoch * self.epoch_steps

    def save_freq(self, epochs: Collection[int], longest: int) -> int:
        """Updates between checkpoints, a divisor of `longest`, so that each of some epochs has its checkpoint."""
        steps = [self.step_of(epoch) for epoch in epochs if epoch != self.last_epoch]  # the last one has one anyway
        every, least = math.gcd(longest, *steps), math.ceil(self.steps / MAX_CHECKPOINTS)
        if every < least:
            raise ValueError(
                f"--epochs={sorted(epochs)} end with updates {sorted(steps)} ({self.autoencoder_steps} of the "
                f"autoencoder, then {self.epoch_steps} an epoch). With `save_freq` = {longest} that needs a checkpoint "
                f"every {every} updates, over {MAX_CHECKPOINTS} in all. Choose epochs, `autoencoder.steps` and "
                f"`save_freq` so that all these updates and `save_freq` have a common divisor of at least {least}."
            )
        return every
