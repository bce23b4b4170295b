"""Change a directory in one atomic step, so that no interruption leaves it half-changed.

LeRobot writes a dataset file by file and closes its parquet files last: a recording killed half-way is unreadable.
Here every change is made to a copy beside the directory, and the finished copy takes the directory's place in a
single rename, after everything in it has reached the disk. Large files are hard-linked into the copy, so that a change
costs what it adds.
"""

import contextlib
import ctypes
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout


class StagedDirectory:
    """A directory that is only ever changed as a whole; it need not exist yet.

    While open, it keeps a hidden working folder beside the directory, `.<name>.staging`, which holds the copy and a
    lock against a second writer. The folder is removed on leaving; what a killed process left is cleared on entering.
    Entering raises an OSError if the place is not writable or another process is changing the directory.
    """

    def __init__(self, root: Path):
        self.root = root
        self._work = root.parent / f".{root.name}.staging"
        self._staged, self._previous, self._scratch = (self._work / name for name in ("staged", "previous", "scratch"))
        self._lock = FileLock(self._work / "lock")

    def __enter__(self) -> "StagedDirectory":
        if self.root.is_mount():
            raise OSError(
                f"{self.root} is a mount point, which cannot be replaced as a whole: choose a folder inside it"
            )
        try:
            self._work.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise BlockingIOError(
                f"Another process is writing to {self.root} (it holds {self._work / 'lock'}). "
                "Wait for it to end, or choose another root."
            ) from error
        except OSError as error:
            raise type(error)(
                error.errno, f"Cannot write to {self.root.parent} ({error.strerror}): choose a writable root"
            ) from error
        if not self.root.exists() and self._previous.exists():
            os.rename(self._previous, self.root)
        self._clear()
        return self

    def __exit__(self, *exc_info: object) -> None:
        shutil.rmtree(self._work, ignore_errors=True)
        self._lock.release()

    @contextlib.contextmanager
    def change(self) -> Iterator[Path]:
        """Give a copy of the directory to change, and put it in the directory's place when the block succeeds.

        What holds of the copy of `stage` holds of this one. Temporary files made inside the block (by `tempfile`) go to
        the working folder too.
        """
        outside = tempfile.tempdir
        self._scratch.mkdir()
        try:
            tempfile.tempdir = str(self._scratch)
            yield self.stage()
            self.commit()
        finally:
            tempfile.tempdir = outside
            self._clear()

    def stage(self) -> Path:
        """Make the copy to change. It does not exist when the directory does not exist yet or is empty.

        Files under `meta/` are copied; all others are hard-linked and must not be changed in place, only added to
        or replaced.
        """
        if not is_empty(self.root):
            shutil.copytree(self.root, self._staged, copy_function=_link_or_copy)
        return self._staged

    def commit(self) -> None:
        """Put the changed copy in the directory's place; an error leaves the directory as it was."""
        _synchronize(self._staged)
        if is_empty(self.root):
            os.replace(self._staged, self.root)
        elif not exchange(self._staged, self.root):
            os.rename(self.root, self._previous)
            try:
                os.rename(self._staged, self.root)
            except OSError:
                os.rename(self._previous, self.root)
                raise
        _synchronize_entry(self.root.parent)
        _synchronize_entry(self._work)
        self._clear()

    def _clear(self) -> None:
        for leftover in (self._staged, self._previous, self._scratch):
            shutil.rmtree(leftover, ignore_errors=True)


def is_empty(folder: Path) -> bool:
    """Whether there is nothing in a folder, or no folder."""
    return not folder.exists() or not any(folder.iterdir())


def exchange(first: Path, second: Path) -> bool:
    """Swap two paths of one file system atomically, where the platform can; `False` leaves both as they were."""
    paths = os.fsencode(first), os.fsencode(second)
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "renameat2"):
        at_cwd, rename_exchange = -100, 2
        return libc.renameat2(at_cwd, paths[0], at_cwd, paths[1], rename_exchange) == 0
    if sys.platform == "darwin":
        rename_swap = 2
        return ctypes.CDLL(None).renamex_np(*paths, rename_swap) == 0
    return False


def _link_or_copy(source: str, target: str) -> None:
    # LeRobot rewrites the files under meta/ in place, which would reach through a hard link into the original.
    if Path(source).parent.name != "meta":
        with contextlib.suppress(OSError):
            os.link(source, target)
            return
    shutil.copy2(source, target)


def _synchronize(folder: Path) -> None:
    """Let a copy reach the disk, so that a loss of power after the rename finds whole files in it."""
    for parent, _, names in os.walk(folder):
        for name in names:
            path = Path(parent, name)
            if path.stat().st_nlink == 1:  # what is linked from the directory was synchronized when it was new
                _synchronize_entry(path)
        _synchronize_entry(Path(parent))


def _synchronize_entry(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
