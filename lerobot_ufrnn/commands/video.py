"""`ufrnn video`: film a door that is found out."""

from dataclasses import dataclass
from pathlib import Path

from env_door.checks import check_range
from env_door.latch import KINDS

from ..analysis.trial_video import annotate, write_gif
from .policies import DoorTrialConfig, load_policy, run_door_trial


@dataclass(kw_only=True)
class VideoConfig(DoorTrialConfig):
    """Films one trial: with `kind=any` the first with a wrong first try that goes back and opens the door at last."""

    policy_path: str
    """Checkpoint folder or Hub repository of a `ufrnn` policy."""
    output: Path = Path("found_out.gif")
    """GIF file to write."""
    size: int = 360
    """Width of the picture in pixels, 16 to 768."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "size", low=16, high=768)


def run(config: VideoConfig) -> None:
    """Runs trials until there is one to show, and writes its film."""
    policy = load_policy(config.policy_path)
    for kind in KINDS if config.kind == "any" else (config.kind,):
        history = run_door_trial(policy, config, kind, film=True, render_size=config.size)
        tried, result = history.outcome
        print(f"{kind} door: tried {tried}; went back {len(history.returns)} times; {result}", flush=True)
        if config.kind != "any" or (history.recovered and history.returns):
            break
    else:
        raise ValueError(
            "In no trial was the first try wrong, the policy contradicted and the door opened at last: give another "
            "--seed, or a --kind to film whatever happens."
        )
    write_gif(annotate(history), config.output)
    print(f"Film: {config.output} ({config.output.stat().st_size / 1e6:.1f} MB)")
