"""FLAME's files load without chumpy or scipy, and nothing in a hostile one is executed."""

from __future__ import annotations

import builtins
import os
import pickle
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from express50.errors import HeadModelError
from express50.head.flame import load_flame, read_embedding
from express50.head.load import load_head
from express50.head.model import landmarks, pose
from tests.express50.head.flame_files import (
    EXPRESSIONS,
    SHAPES,
    VERTICES,
    flame_dict,
    write_embedding,
    write_flame,
)


@pytest.fixture(scope="module")
def flame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flame")
    return write_flame(folder)


def test_arrays_survive_the_stand_ins(flame: Path) -> None:
    model, arrays = load_flame(flame), flame_dict()
    directions = torch.cat([model.shape_dirs, model.expression_dirs], 2).numpy()
    np.testing.assert_allclose(directions, arrays["shapedirs"], atol=1e-7)
    np.testing.assert_allclose(model.joint_regressor.numpy(), arrays["J_regressor"], atol=1e-7)
    assert (len(model.shape_names), len(model.expression_names)) == (SHAPES, EXPRESSIONS)
    assert not model.unit_expressions
    feature = np.random.default_rng(3).normal(size=36)
    by_hand = arrays["posedirs"] @ feature
    got = (torch.from_numpy(feature).float() @ model.pose_dirs).reshape(VERTICES, 3).numpy()
    np.testing.assert_allclose(got, by_hand, atol=1e-6)


def test_loads_by_path_and_poses(flame: Path) -> None:
    model = load_head(str(flame))
    vertices = pose(
        model, torch.randn(2, SHAPES), torch.randn(2, EXPRESSIONS), jaw=torch.rand(2, 3)
    )
    assert landmarks(model, vertices).shape == (2, 68, 3)
    assert model.name.startswith("flame-")
    assert model.regions["left_eyeball"].sum() == 5


@pytest.mark.parametrize("with_torch", [False, True])
def test_embedding_with_or_without_torch_tensors(tmp_path: Path, with_torch: bool) -> None:
    path = tmp_path / "landmark_embedding.npy"
    write_embedding(path, with_torch)
    faces = flame_dict()["f"].astype(np.int64)
    ids, bary, contour = read_embedding(path, faces)
    stored = np.load(path, allow_pickle=True).item()
    np.testing.assert_array_equal(ids, stored["full_lmk_faces_idx"][0])
    np.testing.assert_allclose(bary, stored["full_lmk_bary_coords"][0])
    table = np.asarray(stored["dynamic_lmk_faces_idx"])
    assert contour is not None
    assert all(set(contour[k].tolist()) == set(faces[table[:, k]].ravel()) for k in range(17))


def test_static_embedding_takes_its_contour_from_the_frontal_row(tmp_path: Path) -> None:
    write_embedding(tmp_path / "full.npy", False)
    stored = np.load(tmp_path / "full.npy", allow_pickle=True).item()
    content = {
        "static_lmk_faces_idx": stored["full_lmk_faces_idx"][0, 17:],
        "static_lmk_bary_coords": stored["full_lmk_bary_coords"][0, 17:],
        "dynamic_lmk_faces_idx": stored["dynamic_lmk_faces_idx"],
        "dynamic_lmk_bary_coords": stored["dynamic_lmk_bary_coords"],
    }
    path = tmp_path / "static.npy"
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    ids, _, _ = read_embedding(path, flame_dict()["f"].astype(np.int64))
    np.testing.assert_array_equal(ids[:17], stored["dynamic_lmk_faces_idx"][0])
    np.testing.assert_array_equal(ids[17:], stored["full_lmk_faces_idx"][0, 17:])


class Call:
    """Pickles as a call of a function with arguments."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple:
        return self.call


def payloads(marker: Path) -> dict[str, object]:
    command = f"touch {marker}"
    return {
        "system": Call(os.system, command),
        "eval": Call(builtins.eval, f"open({str(marker)!r}, 'w')"),
        "exec": Call(builtins.exec, f"open({str(marker)!r}, 'w')"),
        "popen": Call(subprocess.Popen, ["touch", str(marker)]),
        "getattr": Call(builtins.getattr, {}, "keys"),
        "nested": {"v_template": [np.zeros(3), (Call(os.system, command),)]},
        "load": Call(pickle.loads, pickle.dumps(Call(os.system, command))),
        "numpy": Call(np.load, str(marker)),
        "torch": Call(torch.load, str(marker)),
    }


NAMES = sorted(payloads(Path("marker")))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("file", ["flame.pkl", "FLAME_masks.pkl", "landmark_embedding.npy"])
@pytest.mark.parametrize("protocol", [2, 5])
def test_hostile_files_execute_nothing(
    flame: Path, tmp_path: Path, name: str, file: str, protocol: int
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(flame.parent, folder)
    marker = tmp_path / "executed"
    content = payloads(marker)[name]
    if file.endswith(".npy"):
        header = (folder / file).read_bytes()[:128]
        array = np.array(content, dtype=object)
        (folder / file).write_bytes(header + pickle.dumps(array, protocol=protocol))
    else:
        (folder / file).write_bytes(pickle.dumps(content, protocol=protocol))
    with pytest.raises(HeadModelError, match="refused or damaged"):
        load_flame(folder / "flame.pkl")
    assert not marker.exists()


def test_a_hostile_storage_inside_a_tensor_executes_nothing(flame: Path, tmp_path: Path) -> None:
    """torch.storage._load_from_bytes nests a second pickle, which must be read as strictly."""
    folder, marker = tmp_path / "copy", tmp_path / "executed"
    shutil.copytree(flame.parent, folder)
    inner = pickle.dumps(Call(os.system, f"touch {marker}"), protocol=2)
    outer = b"\x80\x02ctorch.storage\n_load_from_bytes\nB"
    outer += len(inner).to_bytes(4, "little") + inner + b"\x85R."
    header = (folder / "landmark_embedding.npy").read_bytes()[:128]
    (folder / "landmark_embedding.npy").write_bytes(header + outer)
    with pytest.raises(HeadModelError, match="refused or damaged"):
        load_flame(folder / "flame.pkl")
    assert not marker.exists()


@pytest.mark.parametrize("protocol", [2, pickle.HIGHEST_PROTOCOL])
def test_a_model_that_the_user_saved_again_loads(
    flame: Path, tmp_path: Path, protocol: int
) -> None:
    """With any protocol, of which the newest store arrays in another way."""
    shutil.copytree(flame.parent, tmp_path / "copy")
    path, arrays = tmp_path / "copy" / "flame.pkl", flame_dict()
    arrays["weights"] = np.asfortranarray(arrays["weights"])
    path.write_bytes(pickle.dumps(arrays, protocol=protocol))
    model = load_flame(path)
    np.testing.assert_array_equal(model.skinning.numpy(), arrays["weights"].astype(np.float32))


def test_a_cut_file_is_refused_in_one_line(flame: Path, tmp_path: Path) -> None:
    shutil.copytree(flame.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "flame.pkl"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(HeadModelError) as caught:
        load_flame(path)
    assert "\n" not in str(caught.value)


def test_an_npz_of_flames_arrays_is_distinguished_from_ict_facekits(tmp_path: Path) -> None:
    np.savez(tmp_path / "flame.npz", **flame_dict())
    with pytest.raises(HeadModelError, match="holds FLAME's arrays, expected FLAME's .pkl"):
        load_head(tmp_path / "flame.npz")


def test_missing_companions_are_named_together(flame: Path, tmp_path: Path) -> None:
    shutil.copy(flame, tmp_path / "flame.pkl")
    with pytest.raises(HeadModelError) as caught:
        load_flame(tmp_path / "flame.pkl")
    message = str(caught.value)
    assert "landmark_embedding.npy" in message
    assert "FLAME_masks.pkl" in message
    assert "head_template_mesh.obj" in message


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("weights", np.zeros((VERTICES, 4)), "weights has shape"),
        ("kintree_table", np.zeros((2, 5), int), "joint parents"),
        ("v_template", np.full((VERTICES, 3), np.nan), "template holds NaN"),
        ("posedirs", "text", "expected numbers"),
    ],
)
def test_damaged_arrays_are_named(
    flame: Path, tmp_path: Path, key: str, value: object, message: str
) -> None:
    shutil.copytree(flame.parent, tmp_path / "copy")
    path = tmp_path / "copy" / "flame.pkl"
    path.write_bytes(pickle.dumps({**flame_dict(), key: value}, protocol=2))
    with pytest.raises(HeadModelError, match=message):
        load_flame(path)


def test_out_of_range_embedding_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "landmark_embedding.npy"
    write_embedding(path, False)
    with pytest.raises(HeadModelError, match="landmarks on faces"):
        read_embedding(path, flame_dict()["f"].astype(np.int64)[:3])
