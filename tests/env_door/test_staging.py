import os
import tempfile

import pytest

from env_door.staging import StagedDirectory, exchange


def contents(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_first_change_makes_the_directory(tmp_path):
    root = tmp_path / "deep" / "root"
    with StagedDirectory(root) as directory, directory.change() as staged:
        assert not staged.exists()
        staged.mkdir()
        (staged / "a").write_text("1")
        assert not root.exists()
    assert contents(root.parent) == {"root/a": "1"}


def test_empty_directory_counts_as_absent(tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    with StagedDirectory(root) as directory, directory.change() as staged:
        assert not staged.exists()
        staged.mkdir()
        (staged / "a").write_text("1")
    assert contents(tmp_path) == {"root/a": "1"}


@pytest.mark.parametrize("can_exchange", [True, False])
def test_change_replaces_the_directory(tmp_path, monkeypatch, can_exchange):
    if not can_exchange:
        monkeypatch.setattr("env_door.staging.exchange", lambda first, second: False)
    root = tmp_path / "root"
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info").write_text("old")
    (root / "data").write_text("kept")
    with StagedDirectory(root) as directory, directory.change() as staged:
        (staged / "meta" / "info").write_text("new")
        (staged / "more").write_text("added")
        assert contents(root) == {"meta/info": "old", "data": "kept"}
    assert contents(tmp_path) == {"root/meta/info": "new", "root/data": "kept", "root/more": "added"}


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_failed_change_leaves_everything_as_it_was(tmp_path, error):
    root = tmp_path / "root"
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info").write_text("old")

    def change_half():
        with StagedDirectory(root) as directory, directory.change() as staged:
            (staged / "meta" / "info").write_text("half")
            raise error

    with pytest.raises(type(error)):
        change_half()
    assert contents(tmp_path) == {"root/meta/info": "old"}
    assert os.listdir(tmp_path) == ["root"]


def test_temporary_files_are_made_inside_and_removed(tmp_path):
    before = tempfile.gettempdir()
    with StagedDirectory(tmp_path / "root") as directory, directory.change() as staged:
        staged.mkdir()
        with tempfile.NamedTemporaryFile(delete=False) as file:
            assert str(tmp_path) in file.name
    assert tempfile.gettempdir() == before
    assert os.listdir(tmp_path) == ["root"]


def test_leftovers_of_a_killed_process_are_cleared(tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    (root / "a").write_text("whole")
    half = tmp_path / ".root.staging" / "staged"
    half.mkdir(parents=True)
    (half / "a").write_text("half")
    with StagedDirectory(root) as directory, directory.change() as staged:
        assert contents(staged) == {"a": "whole"}
    assert contents(tmp_path) == {"root/a": "whole"}


def test_directory_set_aside_by_a_killed_process_comes_back(tmp_path):
    previous = tmp_path / ".root.staging" / "previous"
    previous.mkdir(parents=True)
    (previous / "a").write_text("whole")
    with StagedDirectory(tmp_path / "root"):
        pass
    assert contents(tmp_path) == {"root/a": "whole"}


def test_second_writer_is_refused(tmp_path):
    root = tmp_path / "root"
    with StagedDirectory(root), pytest.raises(BlockingIOError, match="Another process"), StagedDirectory(root):
        pass
    with StagedDirectory(root):
        pass


def test_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="choose a writable root"), StagedDirectory(tmp_path / "file" / "root"):
        pass


def test_exchange_of_a_missing_path_changes_nothing(tmp_path):
    (tmp_path / "a").write_text("a")
    assert not exchange(tmp_path / "a", tmp_path / "b")
    assert contents(tmp_path) == {"a": "a"}
