import os
import signal
import subprocess
import sys
import threading

import jobs
import pytest
from jobs import locked, run_command, stop, with_this_python
from waiting import wait_until

SLEEP = "import time; print('asleep', flush=True); time.sleep(60)"


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """Lets a command be Python code, and its runner be a new one."""
    monkeypatch.setattr(jobs, "with_this_python", lambda name: [sys.executable, "-c", name])
    monkeypatch.setattr(jobs, "stopping", threading.Event())


def run(code: str, folder) -> None:
    with locked(folder / "lock") as lock:
        run_command(code, flags={}, log=folder / "logs" / "log", lock=lock)


def log(folder) -> str:
    path = folder / "logs" / "log"
    return path.read_text() if path.exists() else ""


def test_commands_are_modules_of_this_python():
    assert with_this_python("ufrnn") == [sys.executable, "-m", "lerobot_ufrnn.commands"]
    assert with_this_python("lerobot-eval") == [sys.executable, "-m", "lerobot.scripts.lerobot_eval"]


def test_a_command_is_printed_and_runs_on_one_thread_and_its_output_is_kept(tmp_path, capsys):
    for word in ("one", "two"):
        run(f"import os; print('{word}', os.environ['OMP_NUM_THREADS'])", tmp_path)
    assert log(tmp_path).splitlines() == ["one 1", "two 1"]
    assert capsys.readouterr().out.startswith("$ 'import os; ")


def test_a_failure_shows_the_last_lines(tmp_path):
    with pytest.raises(RuntimeError, match=r"(?s)status 3.*log:\n6\n.*20$") as info:
        run("for i in range(21): print(i)\nraise SystemExit(3)", tmp_path)
    assert "\n5\n" not in str(info.value)


def test_stopping_ends_what_runs_and_starts_no_more(tmp_path):
    ended = threading.Event()

    def work() -> None:
        with pytest.raises(KeyboardInterrupt):
            run(SLEEP, tmp_path)
        ended.set()

    thread = threading.Thread(target=work)
    thread.start()
    wait_until(lambda: "asleep\n" in log(tmp_path))
    stop()
    thread.join(20)
    assert ended.is_set()
    with pytest.raises(KeyboardInterrupt):
        run("print('late')", tmp_path)
    assert log(tmp_path) == "asleep\n"


def test_a_stopped_runner_waits_for_a_lock_no_longer(tmp_path):
    with locked(tmp_path / "lock"):
        threading.Timer(0.1, stop).start()
        with pytest.raises(KeyboardInterrupt), locked(tmp_path / "lock"):
            pass


def test_a_command_left_by_a_killed_run_keeps_its_files_locked(tmp_path, capsys):
    code = f"""
import sys
from pathlib import Path
import jobs
jobs.with_this_python = lambda name: [sys.executable, "-c", name]
with jobs.locked(Path("lock")) as lock:
    sleep = "import os; print(os.getpid(), flush=True)\\n" + {SLEEP!r}
    jobs.run_command(sleep, flags={{}}, log=Path("logs/log"), lock=lock)
"""
    path = os.pathsep.join([os.path.dirname(jobs.__file__), os.environ.get("PYTHONPATH", "")])
    killed = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path})
    wait_until(lambda: "asleep\n" in log(tmp_path))
    killed.kill()
    killed.wait()
    left = int(log(tmp_path).splitlines()[-2])
    free = threading.Event()

    def wait() -> None:
        with locked(tmp_path / "lock"):
            free.set()

    thread = threading.Thread(target=wait)
    thread.start()
    assert not free.wait(0.3)
    os.kill(left, signal.SIGKILL)
    assert free.wait(20)
    thread.join()
    assert "waiting for the process that works in" in capsys.readouterr().out
