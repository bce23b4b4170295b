"""`ufrnn foresight`: run one trial and draw what foresight imagined at its branch."""

from dataclasses import dataclass
from pathlib import Path

from env_door.latch import KINDS

from ..analysis.foresight_picture import draw
from .policies import DoorTrialConfig, load_policy, run_door_trial


@dataclass(kw_only=True)
class ForesightPictureConfig(DoorTrialConfig):
    """Draws what was imagined in one trial: with `kind=any` the first in which something was."""

    policy_path: str
    """Checkpoint folder or Hub repository of a `ufrnn` policy trained with `exploration=foresight`."""
    output: Path = Path("foresight.png")
    """Picture to write."""


def run(config: ForesightPictureConfig) -> None:
    """Runs the trial and writes the picture."""
    policy = load_policy(config.policy_path)
    if policy.config.exploration != "foresight":
        raise ValueError(
            "There is foresight only in a policy with exploration=foresight; this one has "
            f"exploration={policy.config.exploration}."
        )
    for kind in KINDS if config.kind == "any" else (config.kind,):
        history = run_door_trial(policy, config, kind)
        if history.imaginations:
            break
    draw(policy, history, config.output)
    print(f"Foresight at the branch: {config.output}")
