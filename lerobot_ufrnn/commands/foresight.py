"""`ufrnn foresight`: run one trial and draw what foresight imagined at its branch."""

from dataclasses import dataclass
from pathlib import Path

from env_door.latch import KINDS

from ..analysis.foresight_picture import draw
from .flags import parse_flags
from .policies import load_policy, run_door_trial


@dataclass
class ForesightConfig:
    """Which trial to draw.

    Args:
        policy_path (`str`):
            Checkpoint folder or Hub repository of a `ufrnn` policy trained with `exploration=foresight`.
        output (`Path`, *optional*, defaults to `foresight.png`):
            Picture to write.
        kind (`str`, *optional*, defaults to `"any"`):
            Kind of the door: `push`, `pull`, `slide` or `random`; `any` takes the first of the three in whose trial
            something is imagined. With recall that is where the first try is wrong.
        arm (`str`, *optional*, defaults to `"ur5e"`):
            `ur5e` or `panda`.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in metres of the range of the door's shift.
        seed (`int`, *optional*, defaults to `2000`):
            Seed of environment and exploration noise.
        num_steps (`int`, *optional*, defaults to `300`):
            Longest trial in steps.
    """

    policy_path: str
    output: Path = Path("foresight.png")
    kind: str = "any"
    arm: str = "ur5e"
    door_offset: float = 0.0
    seed: int = 2000
    num_steps: int = 300


def run(arguments: list[str]) -> None:
    """Runs the trial and writes the picture."""
    config = parse_flags(ForesightConfig, arguments)
    draw_trial(config)
    print(f"Foresight at the branch: {config.output}")


def draw_trial(config: ForesightConfig) -> None:
    """Runs one trial with a trained policy and draws its branch.

    Args:
        config (`ForesightConfig`):
            Which policy and which trial.

    Raises:
        ValueError: If the policy is of another type or runs without foresight, or imagined nothing.
    """
    policy = load_policy(config.policy_path)
    if policy.config.exploration != "foresight":
        raise ValueError(
            "There is foresight only in a policy with exploration=foresight; this one has "
            f"exploration={policy.config.exploration}."
        )
    for kind in KINDS if config.kind == "any" else (config.kind,):
        history = run_door_trial(
            policy, config.seed, config.num_steps, kind=kind, arm=config.arm, door_offset=config.door_offset
        )
        if history.imaginations:
            break
    draw(policy, history, config.output)
