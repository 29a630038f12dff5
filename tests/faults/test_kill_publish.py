"""A folder that is replaced is the old one or the new one after a kill at any step."""

import os
import shutil
import sys

import pytest

from express50.files import atomic
from express50.files.atomic import folder_in_one_step

KILLED = 9


def replace_and_die(root, step):
    """Replace the folder in a child that is killed before its n-th change; say if it was."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == KILLED
    left = [step]

    def hook(event, args):
        del args
        if event in ("open", "os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.listdir"):
            left[0] -= 1
            if left[0] < 0:
                os._exit(KILLED)

    sys.addaudithook(hook)
    with folder_in_one_step(root / "aside", root / "target", keep(root)) as out:
        (out / "a").write_text("new")
        (out / "b").write_text("new")
    os._exit(0)


def keep(root):
    """Keep what is replaced, as the runner does: at most a whole folder, at best the last one."""

    def move(folder):
        shutil.rmtree(root / "kept", ignore_errors=True)
        folder.rename(root / "kept")

    return move


def publish(root, text):
    with folder_in_one_step(root / "aside", root / "target", keep(root)) as out:
        (out / "a").write_text(text)
        (out / "b").write_text(text)


def found(root, name="target"):
    return {f.read_text() for f in sorted((root / name).iterdir())}


@pytest.mark.parametrize("swaps", [True, False])
def test_a_kill_at_any_step_leaves_the_old_folder_or_the_new(tmp_path, monkeypatch, swaps):
    if not swaps:  # as on file systems that cannot
        monkeypatch.setattr(atomic, "_swap", lambda one, other: False)
    elif not can_swap(tmp_path):
        pytest.skip("this file system cannot exchange two folders")
    seen = []
    for step in range(100):
        root = tmp_path / str(step)
        root.mkdir()
        publish(root, "old")
        killed = replace_and_die(root, step)
        seen.append(found(root) if (root / "target").exists() else set())
        publish(root, "again")
        assert found(root) == {"again"}
        if (root / "kept").exists():
            assert found(root, "kept") == (seen[-1] or {"old"})
        assert set(root.iterdir()) <= {root / "target", root / "kept"}
        if not killed:
            break
    assert step > 8
    assert {"old"} in seen and seen[-1] == {"new"}
    # Without the exchange, a kill between two renames leaves nothing: the test sees it.
    assert (set() in seen) == (not swaps)
    assert all(len(texts) <= 1 for texts in seen)


def can_swap(folder):
    for name in ("one", "other"):
        (folder / name).mkdir()
    done = atomic._swap(folder / "one", folder / "other")
    for name in ("one", "other"):
        (folder / name).rmdir()
    return done
