"""`ufrnn hidden`: draw hidden states along the demonstrations and in a trial, model by model."""

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
from lerobot.utils.random_utils import set_seed

from ..analysis.hidden_picture import HiddenPaths, draw
from ..analysis.hidden_states import read_demonstrations, states_along
from .policies import DoorTrialConfig, load_policies, read_provenance, run_door_trial


@dataclass(kw_only=True)
class HiddenConfig(DoorTrialConfig):
    """Draws what policies remember, demonstrations dotted and a trial solid, on the plane of largest variance."""

    policy_paths: list[str]
    """Checkpoint folders or Hub repositories of `ufrnn` policies."""
    dataset_dir: Path
    """Folder of the demonstrations."""
    output: Path = Path("hidden.png")
    """Picture to write; the numbers go beside it, with the ending `.csv`."""
    labels: list[str] = field(default_factory=list)
    """Names of the policies; those of the paper by default."""
    kind: str = "push"
    """Kind of the trial's door: `push`, `pull`, `slide` or `random`, or another of the eight."""
    hold_seconds: float = 0.0
    """Interference: time in seconds for which somebody holds the trial's door still once it has begun to open,
    highlighted in the picture."""


def run(config: HiddenConfig) -> None:
    """Writes the picture and the table."""
    provenance = read_provenance(config.dataset_dir)
    models = {}
    for label, policy in load_policies(config.policy_paths, config.labels).items():
        demonstrations = read_demonstrations(policy, config.dataset_dir)
        kinds = [episode["kind"] for episode in provenance.episodes] if provenance else ["any"] * len(demonstrations)
        set_seed(config.seed)
        states = states_along(policy, demonstrations)
        history = run_door_trial(policy, config, config.kind, hold_seconds=config.hold_seconds)
        models[label] = HiddenPaths.of(kinds, states, history)
    draw(models, config.output)
    numbers = config.output.with_suffix(".csv")
    table = pd.concat({label: model.table for label, model in models.items()}, names=["model", None])
    table.reset_index(level="model").to_csv(numbers, index=False, float_format="%.5f")
    print(f"Hidden states: {config.output}, {numbers}")
