import os
import signal
import subprocess
import sys
import threading

import pytest
from waiting import wait_until

from lerobot_ufrnn.experiments import processes
from lerobot_ufrnn.experiments.processes import Runner, Stopped, with_this_python

SLEEP = "import time; print('asleep', flush=True); time.sleep(60)"


@pytest.fixture
def plain(monkeypatch):
    """Lets a command be Python code."""
    monkeypatch.setattr(processes, "with_this_python", lambda command: [sys.executable, "-c", *command])


def test_commands_are_modules_of_this_python():
    assert with_this_python(["ufrnn", "record"]) == [sys.executable, "-m", "lerobot_ufrnn.commands", "record"]
    assert with_this_python(["lerobot-eval"]) == [sys.executable, "-m", "lerobot.scripts.lerobot_eval"]


def test_a_command_runs_on_one_thread_and_its_output_is_kept(plain, tmp_path):
    log, runner = tmp_path / "logs" / "log", Runner()
    with runner.hold(tmp_path / "lock") as lock:
        for word in ("one", "two"):
            runner.run([f"import os; print('{word}', os.environ['OMP_NUM_THREADS'])"], log, lock)
    assert [line for line in log.read_text().splitlines() if line[0] != "$"] == ["one 1", "two 1"]


def test_a_failure_shows_the_last_lines(plain, tmp_path):
    with (
        Runner().hold(tmp_path / "lock") as lock,
        pytest.raises(RuntimeError, match=r"(?s)status 3.*log:\n6\n.*20$") as info,
    ):
        Runner().run(["for i in range(21): print(i)\nraise SystemExit(3)"], tmp_path / "log", lock)
    assert "\n5\n" not in str(info.value)


def test_stopping_ends_what_runs_and_starts_no_more(plain, tmp_path):
    runner, stopped = Runner(), []

    def work() -> None:
        with runner.hold(tmp_path / "lock") as lock, pytest.raises(Stopped):
            runner.run([SLEEP], tmp_path / "log", lock)
        stopped.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    wait_until(lambda: (tmp_path / "log").exists() and "asleep\n" in (tmp_path / "log").read_text())
    runner.stop()
    thread.join(20)
    assert stopped
    with runner.hold(tmp_path / "lock") as lock, pytest.raises(Stopped):
        runner.run(["print('late')"], tmp_path / "log", lock)
    assert not (tmp_path / "log").read_text().endswith("late\n")


def test_a_command_left_by_a_killed_run_keeps_its_files_locked(tmp_path, capsys):
    code = f"""
import sys
from pathlib import Path
from lerobot_ufrnn.experiments import processes
processes.with_this_python = lambda command: [sys.executable, "-c", *command]
runner = processes.Runner()
with runner.hold(Path("lock")) as lock:
    runner.run(["import os; print(os.getpid(), flush=True)\\n" + {SLEEP!r}], Path("log"), lock)
"""
    killed = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path)
    wait_until(lambda: (tmp_path / "log").exists() and "asleep\n" in (tmp_path / "log").read_text())
    killed.kill()
    killed.wait()
    left = int((tmp_path / "log").read_text().splitlines()[-2])
    held = threading.Event()

    def wait() -> None:
        with Runner().hold(tmp_path / "lock"):
            held.set()

    thread = threading.Thread(target=wait)
    thread.start()
    assert not held.wait(0.3)
    os.kill(left, signal.SIGKILL)
    assert held.wait(20)
    thread.join()
    assert "waiting for the process that works in" in capsys.readouterr().out


def test_a_stopped_runner_waits_no_longer(tmp_path):
    runner = Runner()
    with runner.hold(tmp_path / "lock"):
        threading.Timer(0.1, runner.stop).start()
        with pytest.raises(Stopped), runner.hold(tmp_path / "lock"):
            pass
