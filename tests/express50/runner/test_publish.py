"""Publishing: whole or absent, errors leave the former output, leftovers go."""

import errno
import fcntl
import os

import pytest

from express50.console import system_error_line
from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.files import atomic
from express50.files.atomic import dump_json, folder_in_one_step, write_bytes, write_json
from express50.runner.publish import clean_leftovers, publishing, run_folder, set_aside, stage_lock

ITEM = "S001/cam00"


@pytest.fixture
def dataset(tmp_path):
    return Dataset(tmp_path / "data")


def publish(dataset, text, item=ITEM):
    with run_folder(dataset, "matte") as folder, publishing(folder, dataset, "matte", item) as out:
        (out / "a.txt").write_text(text)


def staged(dataset):
    return list(dataset.staging_dir.iterdir())


def test_folder_appears_only_at_the_end_and_replaces_the_former(dataset):
    target = dataset.item_dir("matte", ITEM)
    with run_folder(dataset, "matte") as run, publishing(run, dataset, "matte", ITEM) as out:
        (out / "old.txt").write_text("1")
        assert not target.exists()
    publish(dataset, "2")
    assert {p.name: p.read_text() for p in target.iterdir()} == {"a.txt": "2"}
    assert staged(dataset) == []


def test_error_in_the_body_leaves_the_former_folder(dataset):
    publish(dataset, "1")
    run = run_folder(dataset, "matte")
    with pytest.raises(RuntimeError), run as at, publishing(at, dataset, "matte", ITEM) as out:
        (out / "a.txt").write_text("half")
        raise RuntimeError
    assert (dataset.item_dir("matte", ITEM) / "a.txt").read_text() == "1"
    assert staged(dataset) == []


def test_everything_is_synced_before_the_rename(dataset, monkeypatch):
    calls = []
    real_sync, real_rename = os.fsync, os.rename
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("sync"), real_sync(fd)))
    monkeypatch.setattr(os, "rename", lambda *a, **k: (calls.append("rename"), real_rename(*a)))
    publish(dataset, "1")
    # the file and its folder before the rename, the parent after it
    assert calls == ["sync", "sync", "rename", "sync"]


def test_leftovers_of_killed_runs_are_removed_for_that_stage_only(dataset):
    run = "-" + "a" * 32
    for stage in ("matte", "track", "matte-mine"):  # the last may be a stage of the user's
        (dataset.staging_dir / (stage + run)).mkdir(parents=True)
    clean_leftovers(dataset, "matte")
    assert sorted(p.name for p in staged(dataset)) == [f"matte-mine{run}", f"track{run}"]


def test_a_worker_that_outlives_its_run_publishes_nothing(dataset):
    publish(dataset, "1")
    with run_folder(dataset, "matte") as folder:
        gone = pytest.raises(FileNotFoundError)
        with gone, publishing(folder, dataset, "matte", ITEM) as out:
            (out / "a.txt").write_text("2")
            clean_leftovers(dataset, "matte")  # as the next run does
        with gone, publishing(folder, dataset, "matte", ITEM):
            pass
    assert (dataset.item_dir("matte", ITEM) / "a.txt").read_text() == "1"
    assert staged(dataset) == []


def test_two_workers_publish_an_item_at_once(dataset, monkeypatch):
    """One comes between the other's attempts to swap and to rename."""
    target = dataset.item_dir("matte", ITEM)

    def publish_too():
        with folder_in_one_step(dataset.root / "other", target) as out:
            (out / "b.txt").write_text("other")

    swap, others = atomic._swap, [publish_too]

    def slow_swap(one, other):
        done = swap(one, other)
        if others:
            others.pop()()
        return done

    monkeypatch.setattr(atomic, "_swap", slow_swap)
    publish(dataset, "mine")
    assert [path.name for path in target.iterdir()] == ["a.txt"]
    assert staged(dataset) == []


def test_publishing_survives_that_a_failed_neighbours_empty_folder_goes(dataset, monkeypatch):
    publish(dataset, "1", "S001/cam01")
    swap, others = atomic._swap, [lambda: set_aside(dataset, "matte", "S001/cam01")]

    def slow_swap(one, other):
        if others:
            others.pop()()
        return swap(one, other)

    monkeypatch.setattr(atomic, "_swap", slow_swap)
    publish(dataset, "2")
    assert (dataset.item_dir("matte", ITEM) / "a.txt").read_text() == "2"


def test_what_a_kill_between_two_renames_moved_away_is_put_back(dataset):
    publish(dataset, "1", "S001/cam+0")
    target = dataset.item_dir("matte", "S001/cam+0")
    with pytest.raises(RuntimeError), run_folder(dataset, "matte") as folder:
        target.rename(folder / f"S001%2Fcam+0-{'0' * 32}.former")
        raise RuntimeError
    assert (target / "a.txt").read_text() == "1" and staged(dataset) == []
    aside = dataset.root / ".part"
    target.rename(aside.with_name(".part.former"))
    with pytest.raises(RuntimeError), folder_in_one_step(aside, target):
        raise RuntimeError
    assert (target / "a.txt").read_text() == "1"


def test_set_aside_hides_an_item_from_later_stages(dataset):
    publish(dataset, "1")
    set_aside(dataset, "matte", ITEM)
    assert not dataset.item_dir("matte", "S001").exists()  # no empty folder stays
    assert (dataset.stale_dir / "matte/S001/cam00/a.txt").read_text() == "1"
    set_aside(dataset, "matte", ITEM)  # there is nothing left to do
    assert (dataset.stale_dir / "matte/S001/cam00").exists()


def test_write_bytes_replaces_in_one_step_and_leaves_nothing_beside(tmp_path):
    path = tmp_path / "deep" / "x.json"
    write_json(path, {"b": 1, "a": [1.5]})
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert [p.name for p in path.parent.iterdir()] == ["x.json"]


def test_json_is_sorted_and_refuses_what_is_not_finite():
    assert (
        dump_json({"b": (1, 2), "a": "ä"}) == '{\n "a": "ä",\n "b": [\n  1,\n  2\n ]\n}\n'.encode()
    )
    with pytest.raises(ValueError, match="not JSON compliant"):
        dump_json({"a": float("inf")})
    with pytest.raises(FormatError, match="Söhne/M ller.*: holds a name that is not UTF-8"):
        dump_json({"a": "Söhne/M\udcfcller"})


def test_a_file_system_without_locks_is_named_with_what_to_do(dataset, monkeypatch):
    def refused(*unused):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", refused)  # as Lustre without -o flock
    with pytest.raises(OSError, match="not implemented") as caught, stage_lock(dataset, "matte"):
        pass
    line = system_error_line(caught.value)
    assert line.startswith(f"OSError: {dataset.staging_dir}/.matte.lock: ") and "-o flock" in line
