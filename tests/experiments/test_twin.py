"""What the experiments on the twin share: a command is ended in order, its end is told, bad flags are refused."""

import signal
import sys

import pytest
import twin
from script import run
from twin import StockCommand, describe_failure, last_error
from twin_faults import FaultsConfig
from twin_recording import RecordingConfig
from twin_trials import TrialsConfig
from waiting import wait_until


@pytest.fixture
def python(monkeypatch):
    """Lets a command be Python code that prints `here` once it is ready; waits until it has."""
    monkeypatch.setattr(twin, "with_this_python", lambda code: [sys.executable, "-c", code])

    def start(code: str) -> StockCommand:
        command = StockCommand(code)
        wait_until(lambda: "here" in command.output())
        return command

    return start


def test_a_command_heeds_an_interrupt_even_if_a_background_job_started_it(python):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with python("import time; print('here', flush=True); time.sleep(60)") as command:
            command.stop()
            assert command.returncode == -signal.SIGINT
            assert "KeyboardInterrupt" in command.output()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_last_error_is_what_the_user_saw():
    output = """Traceback (most recent call last):
  File "x.py", line 3, in <module>
    raise ValueError
ValueError: first

During handling of the above exception, another exception occurred:

lerobot_ufrnn.robots.errors.RobotFaultError: The arm was stopped (freeze): no data. To go on: look at it.
INFO 2025-01-01 errors.py:12 Exiting
"""
    assert last_error(output) == "RobotFaultError: The arm was stopped (freeze): no data"
    assert last_error("INFO all is well\nKeyboardInterrupt\n") == "KeyboardInterrupt"
    assert last_error("INFO no Error in here\n") == ""
    decoder = (
        "[start of libtorchcodec loading traceback]\nOSError: no x.so\n[end of libtorchcodec loading traceback].\n"
    )
    assert last_error(f"WARNING no decoder\n{decoder}INFO Exiting\n") == ""
    assert last_error(f"{decoder}RuntimeError: no arm\n") == "RuntimeError: no arm"
    ending = "WARNING 2025-01-01 orderly_end.py:12 Ending, as asked for by SIGHUP: what is open is closed first.\n"
    assert last_error(ending + "INFO 2025-01-01 Exiting\n") == "Ending, as asked for by SIGHUP"


def test_a_failure_is_told_even_without_an_error():
    assert describe_failure(1, "INFO connected\nValueError: no arm\nINFO bye\n") == "status 1: ValueError: no arm"
    assert describe_failure(2, "usage\nrecord: error: unknown\n") == "status 2: record: error: unknown"
    assert describe_failure(-9, "") == "status -9: it printed nothing"


def test_a_script_tells_what_is_wrong_and_fails(monkeypatch):
    def main(config):
        raise KeyboardInterrupt if config.seed else RuntimeError("no arm")

    for flag, end in (("--seed=0", "x.py: no arm"), ("--seed=1", 130)):
        monkeypatch.setattr(sys, "argv", ["experiments/x.py", "--policy_path=x", "--trial_log=y", flag])
        with pytest.raises(SystemExit) as stopped:
            run(main, TrialsConfig)
        assert stopped.value.code == end


RECORDING = ["--dataset_dir=x", "--repo_id=me/door"]
TRIALS = ["--policy_path=x", "--trial_log=y"]


@pytest.mark.parametrize(
    ("script", "flags", "message"),
    [
        (FaultsConfig, ["--injections=[]"], "--injections must be one or more of"),
        (FaultsConfig, ["--injections=[earthquake]"], "got ['earthquake']"),
        (TrialsConfig, [*TRIALS, "--kinds=[push,push]"], "each once"),
        (TrialsConfig, [*TRIALS, "--hold_seconds=99"], "`hold_seconds` must be at least 0 and at most 60 s"),
        (RecordingConfig, [*RECORDING, "--kinds=[up]"], "kinds must be one or more of"),
        (RecordingConfig, [*RECORDING, "--episode_seconds=nan"], "`episode_seconds` must be at least 12"),
        (RecordingConfig, ["--dataset_dir=x", "--repo_id=door"], "repo_id must read"),
    ],
)
def test_flags_out_of_range_are_refused_before_anything_is_done(monkeypatch, script, flags, message):
    monkeypatch.setattr(sys, "argv", ["experiments/x.py", *flags])
    with pytest.raises(SystemExit) as stopped:
        run(lambda config: None, script)
    assert message in str(stopped.value.code)
