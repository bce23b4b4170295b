"""Which training update ends which epoch."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

AUTOENCODER_STEPS = 400
"""Default of `UFRNNConfig.autoencoder_steps`, stated here so that nothing needs to import PyTorch."""

MAX_CHECKPOINTS = 200


@dataclass(frozen=True)
class Schedule:
    """Updates of a training run, in epochs.

    An epoch is a pass of LeRobot's data loader. An item of it is an episode for `ufrnn` and a frame for any other
    policy; for `ufrnn` the updates of the autoencoder come first and belong to no epoch.

    Attributes:
        autoencoder_steps (`int`): updates before the first epoch.
        epoch_steps (`int`): updates of an epoch.
        steps (`int`): all updates.
    """

    autoencoder_steps: int
    epoch_steps: int
    steps: int

    @classmethod
    def of(cls, settings: dict[str, Any], num_episodes: int, num_frames: int) -> "Schedule":
        """The schedule of a model.

        Args:
            settings (`dict[str, Any]`):
                Its configuration file.
            num_episodes (`int`):
                Demonstrations in the data set.
            num_frames (`int`):
                Frames of all of them.

        Returns:
            `Schedule`: the schedule.

        Raises:
            ValueError: If `steps` does not end with an epoch.
        """
        policy = settings["policy"]
        is_ufrnn = policy["type"] == "ufrnn"
        has_autoencoder = is_ufrnn and policy.get("autoencoder_path") is None
        autoencoder_steps = policy.get("autoencoder_steps", AUTOENCODER_STEPS) if has_autoencoder else 0
        epoch_steps = math.ceil((num_episodes if is_ufrnn else num_frames) / settings["batch_size"])
        steps = settings["steps"]
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
        """`int`: number of epochs."""
        return (self.steps - self.autoencoder_steps) // self.epoch_steps

    def step_of(self, epoch: int) -> int:
        """Updates done when an epoch ends.

        Args:
            epoch (`int`):
                From 1 on.

        Returns:
            `int`: the number in the name of its checkpoint.

        Raises:
            ValueError: If training ends before.
        """
        if not 1 <= epoch <= self.last_epoch:
            raise ValueError(
                f"--epochs must be from 1 to {self.last_epoch}, where `steps` = {self.steps} ends, got {epoch}."
            )
        return self.autoencoder_steps + epoch * self.epoch_steps

    def save_freq(self, epochs: Collection[int], longest: int) -> int:
        """How often to save, so that each of some epochs has its checkpoint.

        Args:
            epochs (`Collection[int]`):
                Epochs that need one; the last has one anyway.
            longest (`int`):
                Updates between checkpoints that the model's file asks for; a divisor of it is taken.

        Returns:
            `int`: updates between checkpoints.

        Raises:
            ValueError: If there would be too many.
        """
        steps = [self.step_of(epoch) for epoch in epochs if epoch != self.last_epoch]
        every = math.gcd(longest, *steps)
        least = math.ceil(self.steps / MAX_CHECKPOINTS)
        if every < least:
            raise ValueError(
                f"--epochs={sorted(epochs)} end with updates {sorted(steps)} ({self.autoencoder_steps} of the "
                f"autoencoder, then {self.epoch_steps} an epoch). With `save_freq` = {longest} that needs a checkpoint "
                f"every {every} updates, over {MAX_CHECKPOINTS} in all. Choose epochs, `autoencoder_steps` and "
                f"`save_freq` so that all these updates and `save_freq` have a common divisor of at least {least}."
            )
        return every
