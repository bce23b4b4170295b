import fcntl
import sys
import threading

import jobs
import pytest
from jobs import locked, run_command, stop
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


def test_a_command_left_by_a_killed_run_keeps_its_files_locked(tmp_path, capsys):
    def work(stream) -> None:
        with pytest.raises(RuntimeError, match="status -9"):
            run_command(SLEEP, flags={}, log=tmp_path / "logs" / "log", lock=stream.fileno())

    def wait() -> None:
        with locked(tmp_path / "lock"):
            free.set()

    free = threading.Event()
    with (tmp_path / "lock").open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        working = threading.Thread(target=work, args=(stream,))
        working.start()
        wait_until(lambda: "asleep\n" in log(tmp_path))
    waiting = threading.Thread(target=wait)  # the file is closed, as when its process was killed
    waiting.start()
    assert not free.wait(0.3)
    (left,) = jobs.running
    left.kill()
    assert free.wait(20)
    working.join()
    waiting.join()
    assert "waiting for the process that works in" in capsys.readouterr().out
