"""Where chains run: side by side on this machine, or on a cluster."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from .chain import Chain, run_chain
from .processes import Runner

TIMEOUT_MIN = 24 * 60
"""Limit of a cluster's job unless another is asked for; a chain that is cut there goes on with the next run."""


def run_locally(chains: list[Chain], workers: int, runner: Runner) -> list[str]:
    """Runs chains side by side on this machine.

    Args:
        chains (`list[Chain]`):
            What to do, the first ones first.
        workers (`int`):
            How many at once.
        runner (`Runner`):
            Runs the commands; stopped when this is interrupted.

    Returns:
        `list[str]`: what failed.
    """
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(run_chain, chain, runner) for chain in chains]
        try:
            return [failure for future in futures for failure in future.result()]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            runner.stop()
            raise


def run_on_cluster(
    chains: list[Chain], workers: int, folder: Path, options: dict[str, Any], cluster: str = "slurm"
) -> list[str]:
    """Submits chains as one job each and waits for them.

    Args:
        chains (`list[Chain]`):
            What to do, the first ones first.
        workers (`int`):
            How many at once.
        folder (`Path`):
            Where submitit keeps what it submits, and the jobs' output.
        options (`dict[str, Any]`):
            For submitit's `AutoExecutor.update_parameters`.
        cluster (`str`, *optional*, defaults to `"slurm"`):
            submitit's name of the kind of cluster; its `local` and `debug` run without one.

    Returns:
        `list[str]`: what failed.

    Raises:
        RuntimeError: If submitit is not installed, or there is no such cluster here.
    """
    try:
        import submitit
    except ImportError as error:
        raise RuntimeError(
            "--executor=slurm needs submitit, which is not installed: `pip install 'lerobot_policy_ufrnn[cluster]'`."
        ) from error
    executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
    executor.update_parameters(
        **{
            "name": "ufrnn",
            "timeout_min": TIMEOUT_MIN,
            "cpus_per_task": 1,
            "slurm_array_parallelism": workers,
            **options,
        }
    )
    jobs = executor.map_array(_run_alone, chains)
    print(
        f"submitted as jobs {', '.join(job.job_id for job in jobs)}; they go on without this process, and the same "
        "command waits for them again",
        flush=True,
    )
    failures = []
    for chain, job in zip(chains, jobs, strict=True):
        try:
            failures += job.result()
        except submitit.core.utils.UncompletedJobError as error:
            print(f"[{chain.name}] failed: {error}", flush=True)
            failures.append(chain.name)
    return failures


def _run_alone(chain: Chain) -> list[str]:
    return run_chain(chain, Runner())
