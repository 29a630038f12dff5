"""Albedo, light and gains from pictures with known ones; the texture baked with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from express50.errors import StageError
from express50.files.images import read_image
from express50.geometry.pixels import linear_to_srgb
from express50.geometry.sampling import sh_polynomials
from pipelines.track.appearance import (
    EVEN_LIGHT,
    Appearance,
    SampleColours,
    bake_albedo,
    estimate,
    residuals,
    spread_of,
    texel_samples,
    trust,
    write_appearance,
)
from pipelines.track.surface import FrameSetCrops, HeadCrop
from tests.pipelines.textured_scenes import RADIUS, ball_head, paint, picture, rig

NAMES = ("a", "b", "c", "d", "e")


def light() -> np.ndarray:
    return np.outer([1.0, 0.2, 0.3, -0.25, 0.05, 0.0, -0.04, 0.03, 0.02], [1.0, 0.95, 0.9])


def moments(count: int = 4, samples: int = 600, seed: int = 0, noise: float = 0.002):
    """A head that turns before five cameras: what they see, albedo (S, 3) and gains."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(samples, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    albedo = rng.uniform(0.45, 0.75, (samples, 3))
    raw = {name: rng.uniform(0.8, 1.25, 3) for name in NAMES}
    mean = np.exp(np.mean([np.log(gain) for gain in raw.values()], axis=0))
    gains = {name: gain / mean for name, gain in raw.items()}
    truth = Appearance(light(), gains, albedo)
    made = []
    for index in range(count):
        angle = 0.5 * (index - (count - 1) / 2)
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        normals = way @ turn.T
        values = np.stack([truth.shade(name, normals) * albedo for name in NAMES])
        values += rng.normal(size=values.shape) * noise
        axes = [np.array([np.sin(a), 0, np.cos(a)]) for a in np.linspace(-1.5, 1.5, 5)]
        weights = np.stack([np.maximum(normals @ axis, 0.0) for axis in axes])
        made.append(SampleColours(NAMES, values, np.where(weights > 0.25, weights, 0.0), normals))
    return made, truth


def test_gains_are_recovered_to_a_percent_and_pictures_are_explained() -> None:
    seen, truth = moments()
    got = estimate(seen)
    for name in NAMES:
        np.testing.assert_allclose(got.gains[name], truth.gains[name], rtol=0.01)
    for one in seen:
        lengths = residuals(got, one, got.albedo)[one.weights > 0]
        assert np.median(lengths) < 0.02
    assert np.isnan(got.albedo).any(1).sum() == (sum(o.weights.sum(0) for o in seen) == 0).sum()


def test_light_and_albedo_are_recovered_up_to_their_common_scale() -> None:
    seen, truth = moments()
    got = estimate(seen)
    for _ in range(3):
        got = estimate(seen, got)
    normals = np.concatenate([one.normals[one.weights.sum(0) > 0] for one in seen])
    shown, true = (sh_polynomials(normals) @ x for x in (got.light, truth.light))
    np.testing.assert_allclose(shown / shown.mean(0), true / true.mean(0), atol=0.1)
    # Without the light's estimate brightness would go into the skin.
    error = np.abs(shown / shown.mean(0) - true / true.mean(0)).mean()
    assert error < 0.25 * np.abs(1 - true / true.mean(0)).mean()


def test_gains_have_mean_one_and_one_camera_has_none() -> None:
    seen, _ = moments(count=1)
    got = estimate([replace(s, cameras=("x",), values=s.values[:1], weights=s.weights[:1])
                    for s in seen])  # fmt: skip
    np.testing.assert_allclose(got.gains["x"], 1.0)
    many = estimate(moments()[0])
    product = np.prod(list(many.gains.values()), axis=0)
    np.testing.assert_allclose(product, 1.0, rtol=1e-9)


@pytest.mark.parametrize("fill", [0.0, 1.0])
def test_black_white_and_unseen_are_finite(fill: float) -> None:
    seen, _ = moments(count=2)
    flat = [replace(one, values=np.full_like(one.values, fill)) for one in seen]
    for case in (flat, [replace(one, weights=0 * one.weights) for one in flat]):
        got = estimate(case)
        assert np.isfinite(got.light).all()
        assert all(np.isfinite(gain).all() and (gain > 0).all() for gain in got.gains.values())
        lengths = residuals(got, case[0], got.albedo)
        assert np.isfinite(lengths).all()
        assert np.isfinite(trust(lengths, spread_of(lengths, case[0].weights))).all()


def test_spread_is_that_of_the_noise_and_outliers_lose_trust() -> None:
    rng = np.random.default_rng(0)
    lengths = np.linalg.norm(rng.normal(size=(4, 5000, 3)) * 0.03, axis=2)
    lengths[:, :500] += 1.0
    assert spread_of(lengths, np.ones((4, 5000))) == pytest.approx(0.03, rel=0.12)
    weights = trust(lengths, 0.03)
    assert weights[:, :500].max() < 0.01 and np.median(weights[:, 500:]) > 0.7


def crop_of(camera, colour=paint, alpha=None) -> HeadCrop:
    level = np.rint(255 * linear_to_srgb(picture(camera, colour=colour).astype(float) ** 2))
    return HeadCrop(camera, level.astype(np.uint8), alpha)


def plain(cameras) -> Appearance:
    return Appearance(EVEN_LIGHT, {c.id: np.ones(3) for c in cameras}, np.zeros((0, 3)))


def broad(places: np.ndarray) -> np.ndarray:
    """Colours that tell left from right and up from down."""
    return np.stack([0.5 + 3 * places[:, 0], 0.5 + 3 * places[:, 1], 0.4 + 0 * places[:, 0]], 1)


def test_texture_is_baked_the_right_way_up_and_freed_of_gains_and_light() -> None:
    model, cameras, side = ball_head(), rig(), 96
    rng = np.random.default_rng(0)
    given = Appearance(light(), {c.id: rng.uniform(0.8, 1.2, 3) for c in cameras}, np.zeros((0, 3)))
    shots = tuple(
        crop_of(c, lambda p, n=c.id: broad(p) * given.shade(n, p / RADIUS)) for c in cameras
    )
    mesh = model.template.numpy()
    albedo, known = bake_albedo(model, mesh[None], [FrameSetCrops((), shots)], given, side)
    assert albedo.shape == (side, side, 3) and albedo.dtype == np.uint8
    v, u = np.meshgrid(1 - (np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side,
                       indexing="ij")  # fmt: skip
    polar, around = np.pi * (1 - v), 2 * np.pi * (u - 0.5)
    places = RADIUS * np.stack(
        [np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], -1
    )
    expected = 255 * linear_to_srgb(broad(places.reshape(-1, 3)).reshape(side, side, 3) ** 2)
    assert 0.2 < known.mean() < 0.6 and known[side // 2, side // 2] and not known[side // 2, 0]
    error = np.abs(albedo - expected)[known]
    assert np.median(error) < 2.0 and np.quantile(error, 0.98) < 8.0
    # What nobody saw goes on from what was seen.
    assert np.abs(albedo[~known].astype(float) - albedo[known].mean(0)).mean() < 60.0
    np.testing.assert_array_equal(
        albedo, bake_albedo(model, mesh[None], [FrameSetCrops((), shots)], given, side)[0]
    )


def test_a_second_frame_shows_what_the_first_hides_and_changes_little_else() -> None:
    model, cameras = ball_head(), rig((-0.8, -0.6, 0.6, 0.8))
    mesh = model.template.numpy()
    first = FrameSetCrops((), tuple(crop_of(c, broad) for c in cameras[:2]))
    other = FrameSetCrops((), tuple(crop_of(c, lambda p: 0.2 + 0 * p) for c in cameras[2:]))
    look = plain(cameras)
    alone, seen = bake_albedo(model, mesh[None], [first], look, 64)
    both, more = bake_albedo(model, np.stack([mesh, mesh]), [first, other], look, 64)
    assert more.sum() > 1.1 * seen.sum() and (more | ~seen).all()
    assert np.abs(both[seen].astype(float) - alone[seen]).mean() < 4.0
    # Not seen at all by the first two, not even at a slant.
    v, u = np.meshgrid(1 - (np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64, indexing="ij")
    new = more & ~seen & (u > 0.68) & (np.abs(v - 0.5) < 0.2)
    assert new.sum() > 20
    assert np.abs(both[new].astype(float) - 255 * linear_to_srgb(0.04)).mean() < 12.0


@pytest.mark.parametrize("alpha", [None, np.zeros((256, 256), np.uint8)])
def test_nothing_seen_is_an_even_grey(alpha) -> None:
    model, cameras = ball_head(12), rig()
    shots = () if alpha is None else tuple(crop_of(c, alpha=alpha) for c in cameras)
    albedo, known = bake_albedo(
        model, model.template.numpy()[None], [FrameSetCrops((), shots)], plain(cameras), 32
    )
    assert not known.any() and len(np.unique(albedo)) == 1


def test_texels_lie_where_the_map_says() -> None:
    model, side = ball_head(), 50
    texels, texture = texel_samples(model, side)
    assert len(texture) > 0.9 * side * side
    np.testing.assert_allclose(texels.weights.sum(1), 1.0)
    number = {tuple(face): k for k, face in enumerate(model.faces.tolist())}
    ids = [number[tuple(face)] for face in texels.vertices.tolist()]
    corners = model.uv.numpy()[model.uv_faces.numpy()[ids]]
    uv = (texels.weights[..., None] * corners).sum(1)
    expected = np.stack([(texture[:, 1] + 0.5) / side, 1 - (texture[:, 0] + 0.5) / side], 1)
    np.testing.assert_allclose(uv, expected, atol=1e-6)


def test_written_files_are_found_by_the_export(tmp_path) -> None:
    from express50.dataset.export import read_albedo

    albedo = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    gains = {"cam1": np.array([0.5, 1.0, 2.0]), "cam0": np.ones(3)}
    write_appearance(tmp_path, albedo, Appearance(light(), gains, np.zeros((0, 3))), ["neutral"])
    np.testing.assert_array_equal(read_albedo(tmp_path), albedo)
    np.testing.assert_array_equal(read_image(tmp_path / "albedo.png"), albedo)
    with np.load(tmp_path / "appearance.npz", allow_pickle=False) as file:
        assert str(file["schema"]) == "express50.appearance/1"
        assert file["cameras"].tolist() == ["cam0", "cam1"]
        np.testing.assert_array_equal(file["gains"], [[1, 1, 1], [0.25, 1, 4]])
        np.testing.assert_array_equal(file["light"], light())
        assert file["expressions"].tolist() == ["neutral"]
    with pytest.raises(StageError, match="not finite|NaN"):
        write_appearance(tmp_path, albedo, Appearance(light() * np.nan, gains, albedo), [])
