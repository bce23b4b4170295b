"""`ufrnn results`: the table of a trial log."""

from dataclasses import dataclass
from pathlib import Path

from env_door.checks import check_range
from env_door.trials import first_of_each_kind, read_trials

from ..analysis.results import count_by_door, to_markdown


@dataclass
class ResultsConfig:
    """Counts the doors that were opened, first tries and recoveries apart."""

    trial_log: Path
    """File that `lerobot-eval --env.trial_log=<file>` wrote."""
    output_dir: Path | None = None
    """Folder for `results.md` and `results.csv`; only printed when not given."""
    trials_per_kind: int | None = None
    """Trials to count of each kind of door, those with the lowest seeds (`lerobot-eval` fills its last batch with a few
    more than were asked for); all when not given."""

    def __post_init__(self) -> None:
        if self.trials_per_kind is not None:
            check_range(self, "trials_per_kind", low=1)


def run(config: ResultsConfig) -> None:
    """Prints the table, and writes it when asked to."""
    trials = read_trials(config.trial_log)
    if config.trials_per_kind is not None:
        trials = first_of_each_kind(trials, config.trials_per_kind)
    counts = count_by_door(trials)
    text = to_markdown(counts)
    if config.output_dir is not None:
        config.output_dir.mkdir(parents=True, exist_ok=True)
        (config.output_dir / "results.md").write_text(text)
        counts.to_csv(config.output_dir / "results.csv")
    print(text, end="")
