"""`ufrnn results`: the table of a trial log."""

from dataclasses import dataclass
from pathlib import Path

from env_door.trials import read_trials

from ..analysis.results import summarize, to_csv, to_markdown
from .flags import parse_flags


@dataclass
class ResultsConfig:
    """What to summarise.

    Args:
        trial_log (`Path`):
            File that `lerobot-eval --env.trial_log=<file>` wrote.
        output_dir (`Path`, *optional*):
            Folder for `results.md` and `results.csv`; only printed when not given.
    """

    trial_log: Path
    output_dir: Path | None = None


def run(arguments: list[str]) -> None:
    """Prints the table, and writes it when asked to."""
    config = parse_flags(ResultsConfig, arguments)
    rows = summarize(read_trials(config.trial_log))
    if config.output_dir is not None:
        config.output_dir.mkdir(parents=True, exist_ok=True)
        (config.output_dir / "results.md").write_text(to_markdown(rows))
        (config.output_dir / "results.csv").write_text(to_csv(rows))
    print(to_markdown(rows), end="")
