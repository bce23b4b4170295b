import os
import tempfile

import pytest

from env_door.staging import StagedDirectory, exchange


def contents(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("is_there", [False, True])
def test_first_change_makes_the_directory_or_fills_an_empty_one(tmp_path, is_there):
    root = tmp_path / "deep" / "root"
    if is_there:
        root.mkdir(parents=True)
    with StagedDirectory(root) as directory, directory.change() as staged:
        assert not staged.exists()
        staged.mkdir()
        (staged / "a").write_text("1")
        assert root.exists() == is_there
    assert contents(tmp_path) == {"deep/root/a": "1"}


@pytest.fixture
def root(tmp_path):
    """A directory to change."""
    (tmp_path / "root" / "meta").mkdir(parents=True)
    (tmp_path / "root" / "meta" / "info").write_text("old")
    (tmp_path / "root" / "data").write_text("kept")
    return tmp_path / "root"


@pytest.mark.parametrize("can_exchange", [True, False])
def test_change_replaces_the_directory(tmp_path, root, monkeypatch, can_exchange):
    if not can_exchange:
        monkeypatch.setattr("env_door.staging.exchange", lambda first, second: False)
    with StagedDirectory(root) as directory, directory.change() as staged:
        (staged / "meta" / "info").write_text("new")
        (staged / "more").write_text("added")
        assert contents(root) == {"meta/info": "old", "data": "kept"}
    assert contents(tmp_path) == {"root/meta/info": "new", "root/data": "kept", "root/more": "added"}


@pytest.mark.parametrize("can_exchange", [True, False])
def test_all_that_is_new_is_on_the_disk_before_it_takes_the_place(tmp_path, root, monkeypatch, can_exchange):
    """So that a loss of power leaves the old directory or the new one."""
    synchronized, at_exchange, fsync = set(), [], os.fsync

    def remember(descriptor):
        fsync(descriptor)
        synchronized.add(os.fstat(descriptor).st_ino)

    def look(first, second):
        new = [first, *first.rglob("*")]
        at_exchange.append({path.name for path in new if path.stat().st_ino not in synchronized})
        return can_exchange and exchange(first, second)

    monkeypatch.setattr(os, "fsync", remember)
    monkeypatch.setattr("env_door.staging.exchange", look)
    with StagedDirectory(root) as directory, directory.change() as staged:
        (staged / "deep").mkdir()
        (staged / "deep" / "more").write_text("added")
    assert at_exchange == [{"data"}]  # the one that was linked, not written
    assert tmp_path.stat().st_ino in synchronized


def test_a_directory_that_cannot_be_replaced_stays(tmp_path, root, monkeypatch):
    rename = os.rename

    def fail(source, target):
        if source.name == "staged":
            raise OSError("busy")
        rename(source, target)

    monkeypatch.setattr("env_door.staging.exchange", lambda first, second: False)
    monkeypatch.setattr(os, "rename", fail)
    with pytest.raises(OSError, match="busy"), StagedDirectory(root) as directory, directory.change() as staged:
        (staged / "more").write_text("added")
    assert contents(tmp_path) == {"root/meta/info": "old", "root/data": "kept"}


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_failed_change_leaves_everything_as_it_was(tmp_path, root, error):
    def change_half():
        with StagedDirectory(root) as directory, directory.change() as staged:
            (staged / "meta" / "info").write_text("half")
            raise error

    with pytest.raises(type(error)):
        change_half()
    assert contents(tmp_path) == {"root/meta/info": "old", "root/data": "kept"}
    assert os.listdir(tmp_path) == ["root"]


def test_temporary_files_are_made_inside_and_removed(tmp_path):
    before = tempfile.gettempdir()
    with StagedDirectory(tmp_path / "root") as directory, directory.change() as staged:
        staged.mkdir()
        with tempfile.NamedTemporaryFile(delete=False) as file:
            assert str(tmp_path) in file.name
    assert tempfile.gettempdir() == before
    assert os.listdir(tmp_path) == ["root"]


def test_leftovers_of_a_killed_process_are_cleared(tmp_path, root):
    half = tmp_path / ".root.staging" / "staged"
    half.mkdir(parents=True)
    (half / "data").write_text("half")
    with StagedDirectory(root) as directory, directory.change() as staged:
        assert contents(staged) == {"meta/info": "old", "data": "kept"}
    assert contents(tmp_path) == {"root/meta/info": "old", "root/data": "kept"}


def test_directory_set_aside_by_a_killed_process_comes_back(tmp_path, root):
    (tmp_path / ".root.staging").mkdir()
    root.rename(tmp_path / ".root.staging" / "previous")
    with StagedDirectory(root):
        pass
    assert contents(tmp_path) == {"root/meta/info": "old", "root/data": "kept"}


def test_second_writer_is_refused(root):
    with StagedDirectory(root), pytest.raises(BlockingIOError, match="Another process"), StagedDirectory(root):
        pass
    with StagedDirectory(root):
        pass


def test_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="choose a writable root"), StagedDirectory(tmp_path / "file" / "root"):
        pass


def test_a_mount_point_is_refused_before_anything_is_recorded(tmp_path, root, monkeypatch):
    monkeypatch.setattr(type(root), "is_mount", lambda path: path == root)
    with pytest.raises(OSError, match="is a mount point"), StagedDirectory(root):
        pass
    assert os.listdir(tmp_path) == ["root"]


def test_exchange_of_a_missing_path_changes_nothing(tmp_path):
    (tmp_path / "a").write_text("a")
    assert not exchange(tmp_path / "a", tmp_path / "b")
    assert contents(tmp_path) == {"a": "a"}
