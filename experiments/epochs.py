"""A configuration file for `lerobot-train`, and which of its updates ends which epoch."""

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import yaml

AUTOENCODER_STEPS = 400  # default of `policy.autoencoder.steps`, stated here because the configuration imports PyTorch
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


def find_checkpoints(
    settings: dict[str, Any], num_episodes: int, num_frames: int, epochs: Collection[int]
) -> tuple[dict[int, int], int]:
    """The update that ends each of some epochs, in order, and the updates between checkpoints so that each has one.

    An epoch is a pass of LeRobot's data loader, whose items are episodes for `ufrnn` and frames for other policies; for
    `ufrnn` the updates of the autoencoder come first and belong to no epoch. Without `epochs` the last one; a
    ValueError if `steps` does not end with an epoch, or epochs would need too many checkpoints.
    """
    policy, steps = settings["policy"], settings["steps"]
    items, first = num_frames, 0
    if policy["type"] == "ufrnn":
        items, autoencoder = num_episodes, policy.get("autoencoder") or {}
        first = 0 if autoencoder.get("path") else autoencoder.get("steps", AUTOENCODER_STEPS)
    epoch_steps = math.ceil(items / settings["batch_size"])
    last_epoch = (steps - first) / epoch_steps
    if last_epoch < 1 or last_epoch % 1:
        raise ValueError(
            f"`steps` must be {first} updates of the autoencoder and a multiple of the {epoch_steps} of an epoch, such "
            f"as {first + max(1, round(last_epoch)) * epoch_steps}; got {steps}."
        )
    if epochs and not 1 <= min(epochs) <= max(epochs) <= last_epoch:
        raise ValueError(
            f"--epochs must be from 1 to {last_epoch:.0f}, where `steps` = {steps} ends, got {sorted(epochs)}."
        )
    step_of = {epoch: first + epoch * epoch_steps for epoch in sorted(epochs) or [int(last_epoch)]}
    longest = max(0, settings.get("save_freq") or 0) or steps
    wanted = [step for step in step_of.values() if step < steps]  # the last update has a checkpoint anyway
    every, least = math.gcd(longest, *wanted), math.ceil(steps / MAX_CHECKPOINTS)
    if every < least:
        raise ValueError(
            f"--epochs={sorted(epochs)} end with updates {wanted} ({first} of the autoencoder, then {epoch_steps} an "
            f"epoch). With `save_freq` = {longest} that needs a checkpoint every {every} updates, over "
            f"{MAX_CHECKPOINTS} in all. Choose epochs, `autoencoder.steps` and `save_freq` so that all these updates "
            f"and `save_freq` have a common divisor of at least {least}."
        )
    return step_of, every
