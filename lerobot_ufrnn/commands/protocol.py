"""`ufrnn protocol`: train and evaluate models x seeds x checkpoints, with a table to commit."""

import logging
import signal

from ..analysis.evaluation_table import InterferenceRow, ProtocolRow, read_table
from ..analysis.rate_table import interference_tables, success_tables
from ..experiments.chain import plan
from ..experiments.configuration import ProtocolConfig
from ..experiments.demonstrations import record_missing
from ..experiments.executors import run_locally, run_on_cluster
from ..experiments.model import Model
from ..experiments.processes import Runner
from .flags import parse_flags

# Nothing here imports LeRobot or PyTorch: their memory would lie idle while the commands need it.


def run(arguments: list[str]) -> None:
    """Does what is not done yet, and shows the summary.

    Raises:
        ValueError: If the table is of another kind.
        RuntimeError: If something failed; the rest was done all the same.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    config = parse_flags(ProtocolConfig, arguments)
    if config.table.exists():
        read_table(config.table, config.row_type)  # refuses another kind of table before the work
    models = [Model.read(path) for path in config.models]
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `kill` ends the commands as Ctrl-C does
    runner = Runner()
    try:
        record_missing(config, runner)
        chains = plan(config, models)
        if config.executor == "local":
            failures = run_locally(chains, config.workers, runner)
        else:
            folder = config.output_dir / "submitit"
            failures = run_on_cluster(chains, config.workers, folder, config.cluster_options)
    except KeyboardInterrupt:
        runner.stop()
        raise
    if config.table.exists():
        print(f"\n{_summary(config)}\nAll rows are in {config.table}.")
    if failures:
        raise RuntimeError(f"{len(failures)} failed, see above: {'; '.join(failures)}.")


def _summary(config: ProtocolConfig) -> str:
    if config.hold_seconds > 0:
        tables = interference_tables(read_table(config.table, InterferenceRow))
    else:
        tables = success_tables(read_table(config.table, ProtocolRow))
    return "\n".join(table.to_markdown() for table in tables)
