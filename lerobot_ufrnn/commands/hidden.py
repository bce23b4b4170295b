"""`ufrnn hidden`: draw hidden states along the demonstrations and in a trial, model by model."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.utils.random_utils import set_seed

from ..analysis.hidden_picture import HiddenPaths, draw, to_csv
from ..analysis.hidden_states import read_demonstrations, states_along
from .flags import parse_flags
from .policies import load_policies, read_provenance, run_door_trial


@dataclass
class HiddenConfig:
    """Which policies to compare, and in which trial.

    Args:
        policy_paths (`list[str]`):
            Checkpoint folders or Hub repositories of `ufrnn` policies.
        dataset_dir (`Path`):
            Folder of the demonstrations.
        output (`Path`, *optional*, defaults to `hidden.png`):
            Picture to write; the numbers go beside it, with the ending `.csv`.
        labels (`list[str]`, *optional*):
            Names of the policies; those of the paper by default.
        kind (`str`, *optional*, defaults to `"push"`):
            Kind of the trial's door: `push`, `pull`, `slide` or `random`.
        arm (`str`, *optional*, defaults to `"ur5e"`):
            `ur5e` or `panda`.
        door_offset (`float`, *optional*, defaults to `0.0`):
            Half-width in metres of the range of the door's shift.
        hold_seconds (`float`, *optional*, defaults to `0.0`):
            Interference: time in seconds for which somebody holds the trial's door still once it has begun to open,
            highlighted in the picture.
        seed (`int`, *optional*, defaults to `2000`):
            Seed of environment and exploration noise.
        num_steps (`int`, *optional*, defaults to `300`):
            Longest trial in steps.
    """

    policy_paths: list[str]
    dataset_dir: Path
    output: Path = Path("hidden.png")
    labels: list[str] = field(default_factory=list)
    kind: str = "push"
    arm: str = "ur5e"
    door_offset: float = 0.0
    hold_seconds: float = 0.0
    seed: int = 2000
    num_steps: int = 300


def run(arguments: list[str]) -> None:
    """Writes the picture and the table."""
    config = parse_flags(HiddenConfig, arguments)
    provenance = read_provenance(config.dataset_dir)
    models = []
    for label, policy in load_policies(config.policy_paths, config.labels).items():
        demonstrations = read_demonstrations(policy, config.dataset_dir)
        kinds = [episode["kind"] for episode in provenance.episodes] if provenance else ["any"] * len(demonstrations)
        set_seed(config.seed)
        states = states_along(policy, demonstrations)
        history = run_door_trial(
            policy,
            config.seed,
            config.num_steps,
            kind=config.kind,
            arm=config.arm,
            door_offset=config.door_offset,
            hold_seconds=config.hold_seconds,
        )
        models.append(HiddenPaths.of(label, kinds, states, history))
    draw(models, config.output)
    table = config.output.with_suffix(".csv")
    table.write_text(to_csv(models))
    print(f"Hidden states: {config.output}, {table}")
