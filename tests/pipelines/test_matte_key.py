"""Mattes against alpha known by construction, and against the plain keys they must beat."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.matte_scenes import make_scene as hair_before
from express50.errors import ConfigError
from express50.geometry.pixels import linear_to_srgb, srgb_to_linear
from pipelines.matte import MatteConfig
from pipelines.matte.key import (
    dilated,
    eroded,
    eroded_about,
    key_alpha,
    plate_difference,
    subject_window,
)
from pipelines.matte.learned import MattingLaplacian
from pipelines.matte.plates import (
    GOOD_SHARE,
    LEAST_SHARE,
    exposed,
    exposure_gain,
    fit_plate,
    local_colours,
    match_plate,
    shrunk,
    solve_opacity,
)
from tests.pipelines.matte_scenes import Scene, clutter, make_scene


def key(scene: Scene, **changes) -> np.ndarray:
    """Alpha (H, W) of a scene."""
    valid = np.ones(scene.alpha.shape, bool)
    return key_alpha(scene.frame, scene.plate, valid, MatteConfig(**changes).shadow)


def mae(alpha: np.ndarray, scene: Scene) -> float:
    """Mean absolute error of alpha over the image."""
    return float(np.abs(alpha - scene.alpha).mean())


@pytest.mark.parametrize("look", ["dark", "fair", "black"])
def test_alpha_is_close_and_beats_plain_keys(look: str) -> None:
    scene = make_scene(3, look)
    difference = np.abs(scene.frame.astype(float) - scene.plate).max(axis=-1)
    ramp = np.clip((difference - 8) / 40, 0, 1)
    ours = mae(key(scene), scene)
    assert ours < 0.012
    assert ours < 0.6 * mae(difference > 24, scene)
    assert ours < 0.8 * mae(ramp, scene)


def test_strands_are_found_and_gaps_between_them_kept() -> None:
    scene = make_scene(4, "dark")
    alpha = key(scene)
    upper = np.s_[: int(0.45 * 256)]
    soft = (scene.alpha[upper] > 0.1) & (scene.alpha[upper] < 0.9)
    assert np.abs(alpha[upper] - scene.alpha[upper])[soft].mean() < 0.12
    assert np.corrcoef(alpha[upper][soft], scene.alpha[upper][soft])[0, 1] > 0.8


def test_noise_that_doubles_does_not_reach_the_background() -> None:
    scene = make_scene(5, "fair", noise=5.0)
    alpha = key(scene)
    assert alpha[scene.alpha == 0].mean() < 0.01
    assert mae(alpha, scene) < 0.03


def test_a_subject_that_hardly_exceeds_the_noise_is_found() -> None:
    scene, rng = make_scene(5, "fair"), np.random.default_rng(0)

    def underexposed(image: np.ndarray) -> np.ndarray:
        light = srgb_to_linear(image / 255.0) / 16 + rng.normal(0, 0.004, image.shape)
        return np.rint(255 * linear_to_srgb(light.clip(0, 1))).astype(np.uint8)

    dark = replace(scene, frame=underexposed(scene.frame), plate=underexposed(scene.plate))
    assert mae(key(dark), dark) < 0.02  # an empty matte is 0.24 off
    empty = replace(dark, frame=underexposed(scene.plate), alpha=np.zeros_like(scene.alpha))
    assert mae(key(empty), empty) == 0


def test_a_shirt_that_hardly_exceeds_the_noise_is_found_beside_a_face_that_does() -> None:
    rng = np.random.default_rng(1)
    alpha = np.zeros((256, 256), np.float32)
    cv2.circle(alpha, (128, 90), 45, 1.0, -1)
    alpha[125:160, 110:146] = alpha[150:, 60:196] = 1.0
    wall = np.full((256, 256, 3), (110, 112, 115), np.float32)
    face_and_shirt = np.where(np.arange(256)[:, None, None] < 140, (200, 150, 130), (92, 90, 105))
    still = np.where(alpha[..., None] > 0, face_and_shirt, wall)
    frame, plate = (np.rint(p + rng.normal(0, 6, p.shape)).astype(np.uint8) for p in (still, wall))
    found = key_alpha(frame, plate, np.ones(alpha.shape, bool), 0.25)
    assert np.abs(found - alpha).mean() < 0.02


def test_exposure_change_between_plate_and_frame_is_undone() -> None:
    scene = make_scene(6, "dark", gain=0.9)
    gain = exposure_gain(scene.frame, scene.plate)
    # 0.9 in sRGB values is about 0.9^2.2 in light.
    assert gain == pytest.approx(0.9**2.2, abs=0.03)
    assert mae(key(scene), scene) < 0.012


def test_a_shadow_is_not_the_subject() -> None:
    scene = make_scene(7, "dark", shadow=0.2)
    dark = np.s_[int(0.65 * 256) : int(0.75 * 256), int(0.78 * 256) : int(0.88 * 256)]
    assert key(scene)[dark].mean() < 0.02
    assert mae(key(scene), scene) < mae(key(scene, shadow=0.0), scene)


def test_a_plate_coloured_spot_inside_the_subject_is_filled() -> None:
    scene = make_scene(8, "dark")
    frame = scene.frame.copy()
    spot = np.s_[150:158, 124:132]
    frame[spot] = scene.plate[spot]
    assert key(replace(scene, frame=frame))[spot].min() == 1.0


def test_a_wide_gap_in_the_subject_shows_the_plate() -> None:
    scene = make_scene(8, "dark")
    frame = scene.frame.copy()
    gap = np.s_[130:160, 118:138]
    noise = np.random.default_rng(1).normal(size=scene.plate[gap].shape)
    frame[gap] = np.clip(np.rint(scene.plate[gap] + 2 * noise), 0, 255)
    alpha = key(replace(scene, frame=frame))
    assert alpha[134:156, 122:134].max() < 0.05
    subject = scene.alpha > 0.99
    subject[gap] = False
    assert alpha[subject].mean() > 0.995


def test_the_difference_is_one_where_only_noise_differs() -> None:
    rng = np.random.default_rng(9)
    true = clutter(rng, 200)
    plate, frame = (
        np.clip(np.rint(true + rng.normal(size=true.shape) * 3), 0, 255).astype(np.uint8)
        for _ in range(2)
    )
    model = fit_plate(plate, frame, np.ones(plate.shape[:2], bool))
    assert np.median(model.sigma) == pytest.approx(3 * np.sqrt(2), rel=0.1)
    _, difference, _ = plate_difference(frame.astype(np.float32), model, 0.0, 200)
    assert np.sqrt(np.mean(difference**2)) == pytest.approx(1.0, abs=0.1)


def test_a_wall_that_is_darker_on_one_side_is_not_taken_for_noise() -> None:
    """Somebody in the room takes light from one side of the wall."""
    scene = make_scene(6, "dark")
    light = np.linspace(0.9, 1.0, scene.frame.shape[1])[:, None]
    shaded = replace(scene, frame=np.rint(scene.frame * light).astype(np.uint8))
    sigma = {
        other: np.median(fit_plate(one.plate, one.frame, np.ones(one.alpha.shape, bool)).sigma)
        for other, one in (("even", scene), ("shaded", shaded))
    }
    assert sigma["shaded"] < 1.2 * sigma["even"]
    assert mae(key(shaded), scene) < 1.1 * mae(key(scene), scene)


def test_grey_footage_is_keyed_without_a_warning() -> None:
    """Grey pixels equal the plate exactly, and OpenCV's running means went under 0 there."""
    scene = make_scene(6, "dark")
    images = (scene.frame, scene.plate)
    grey = [np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, 2) for image in images]
    scene = replace(scene, frame=grey[0], plate=grey[1])
    assert mae(key(scene), scene) < 0.03


def test_no_gain_leaves_the_plate_as_it_is() -> None:
    plate = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    assert np.array_equal(exposed(plate, np.ones(3)), plate)
    assert np.abs(exposed(plate, np.full(3, 1.05)) - plate).max() < 8


def test_alpha_of_a_known_mixture_is_exact_where_the_colours_are() -> None:
    alpha, none = np.linspace(0, 1, 11), np.zeros((11, 3, 3))
    front, behind = np.array([[0.1, 0.05, 0.02]] * 11), np.array([[0.4, 0.5, 0.6]] * 11)
    seen = alpha[:, None] * front + (1 - alpha[:, None]) * behind
    noise = none + 1e-5 * np.eye(3)
    value, deviation, at_zero = solve_opacity(seen, behind, front, none, noise)
    assert value == pytest.approx(alpha, abs=1e-6)  # of single precision
    # One channel's noise over the distance of the colours.
    assert deviation == pytest.approx(np.sqrt(1e-5) / np.linalg.norm(front - behind, axis=1), 1e-3)
    assert at_zero == pytest.approx(deviation)


def test_brighter_strands_keep_their_opacity() -> None:
    alpha = np.linspace(0.2, 0.9, 8)
    mean, behind = np.array([[0.5, 0.35, 0.15]] * 8), np.array([[0.3, 0.3, 0.32]] * 8)
    seen = alpha[:, None] * 1.25 * mean + (1 - alpha[:, None]) * behind
    noise = np.zeros((8, 3, 3)) + 1e-6 * np.eye(3)
    outer = mean[:, :, None] * mean[:, None, :]
    rigid = solve_opacity(seen, behind, mean, 0 * outer, noise)[0]
    spread = solve_opacity(seen, behind, mean, 0.2**2 * outer, noise)[0]
    assert np.abs(spread - alpha).max() < 0.03 < 0.1 < (rigid - alpha).max()


def test_hair_of_the_walls_mean_colour_is_found_by_its_bright_and_dark_strands() -> None:
    rng = np.random.default_rng(3)
    behind = np.full((400, 3), 0.2)
    strands = behind * rng.normal(1, 0.2, (400, 1))
    wall, hair = (light + rng.normal(0, 0.004, (400, 3)) for light in (behind, strands))
    covariance = np.full((400, 3, 3), (0.2 * 0.2) ** 2) + 1e-6 * np.eye(3)
    noise = np.zeros((400, 3, 3)) + 0.004**2 * np.eye(3)
    off, on = (
        solve_opacity(seen, behind, behind + 1e-4, covariance, noise)[0] for seen in (wall, hair)
    )
    assert off.mean() < 0.3 and on[np.abs(strands - behind)[:, 0] > 0.03].mean() > 0.75


def test_colours_come_from_the_nearest_that_count() -> None:
    light = np.zeros((40, 60, 3), np.float32)
    light[:, :30], light[:, 30:] = (0.8, 0.4, 0.2), (0.1, 0.2, 0.3)
    weight = np.zeros((40, 60), np.float32)
    weight[10:30, :8] = weight[10:30, 52:] = 1
    where = np.zeros((40, 60), bool)
    where[20, 14] = where[20, 46] = True
    mean, covariance = local_colours(light, weight, where, 3.0, 0.1)
    assert mean == pytest.approx(np.array([light[0, 0], light[0, 59]]), abs=0.01)
    for own, found in zip(mean, covariance, strict=True):
        assert own @ found @ own / (own @ own) ** 2 == pytest.approx(0.1**2, rel=0.3)
        assert np.linalg.eigvalsh(found).min() > 0


def test_shrinking_drops_doubt_and_keeps_what_is_sure() -> None:
    values = np.array([-0.1, 0.01, 0.019, 0.5, 1.0])
    shrunk_to = shrunk(values, np.full(5, 0.02))
    assert (shrunk_to[:3] == 0).all() and shrunk_to[3:] == pytest.approx(values[3:], abs=1e-3)


def test_strands_before_a_shadow_are_measured_against_the_darkened_plate() -> None:
    lit, shaded = make_scene(17, "black"), make_scene(17, "black", shadow=0.2)
    assert mae(key(shaded), shaded) < 1.2 * mae(key(lit), lit) + 1e-3


def test_the_matting_laplacian_is_symmetric_and_ignores_affine_functions_of_colour() -> None:
    rng = np.random.default_rng(14)
    image, band = rng.random((12, 15, 3)), np.ones((12, 15), bool)
    laplacian = MattingLaplacian(image, band)
    assert np.abs(laplacian.product(np.full((12, 15), 0.7))).max() < 1e-9
    affine = image @ [0.3, -0.5, 0.2] + 0.4
    assert abs(np.sum(affine * laplacian.product(affine))) < 1e-2
    a, b = rng.random((2, 12, 15))
    assert np.sum(a * laplacian.product(b)) == pytest.approx(np.sum(b * laplacian.product(a)))
    one = np.zeros((12, 15))
    one[4, 6] = 1.0
    assert laplacian.product(one)[4, 6] == pytest.approx(laplacian.diagonal()[4, 6])


def test_discs_by_distance_are_the_morphology() -> None:
    mask = np.random.default_rng(15).random((50, 40)) > 0.2
    y, x = np.mgrid[-3:4, -3:4]
    disc = (x**2 + y**2 <= 9).astype(np.uint8)
    assert np.array_equal(eroded(mask, 3), cv2.erode(mask.astype(np.uint8), disc) > 0)
    assert np.array_equal(dilated(mask, 3), cv2.dilate(mask.astype(np.uint8), disc) > 0)
    assert eroded(np.ones((5, 5), bool), 3).all() and not dilated(np.zeros((5, 5), bool), 3).any()


def test_wide_discs_are_laid_down_at_a_reduced_size() -> None:
    y, x = np.mgrid[:301, :407]
    mask = (np.hypot(x - 150, y - 140) < 120.3) | (x > 330)
    about = eroded_about(mask, 64)
    assert not (about & ~eroded(mask, 64 - 6)).any() and not (eroded(mask, 64 + 6) & ~about).any()
    assert np.array_equal(eroded_about(mask, 31), eroded(mask, 31))
    assert about[:, -1].all()  # the image's border counts as inside


def test_pixels_without_footage_are_transparent() -> None:
    scene = make_scene(11, "dark")
    valid = np.ones(scene.alpha.shape, bool)
    valid[:, :20] = valid[-30:] = False
    frame = np.where(valid[..., None], scene.frame, 0).astype(np.uint8)
    plate = np.where(valid[..., None], scene.plate, 0).astype(np.uint8)
    alpha = key_alpha(frame, plate, valid, MatteConfig().shadow)
    assert (alpha[~valid] == 0).all() and alpha[120, 128] == 1


def test_a_window_around_the_subject_harms_nothing(monkeypatch) -> None:
    scene, side = make_scene(3, "fair"), (0, 0, 200, 200)
    plate = cv2.copyMakeBorder(scene.plate, *side, cv2.BORDER_REFLECT_101)
    frame = np.clip(plate + np.random.default_rng(0).normal(0, 1.5, plate.shape), 0, 255)
    frame[:, 200:-200] = scene.frame
    alpha = cv2.copyMakeBorder(scene.alpha, *side, cv2.BORDER_CONSTANT)
    wide = Scene(frame=frame.astype(np.uint8), plate=plate, alpha=alpha)
    whole = mae(key(wide), wide)
    monkeypatch.setattr("pipelines.matte.key.WINDOW_SIDE", 160)
    valid = np.ones(wide.alpha.shape, bool)
    columns = subject_window(wide.frame, plate, valid, MatteConfig().shadow)[1]
    assert columns.stop - columns.start < 0.5 * frame.shape[1]
    assert mae(key(wide), wide) < 1.02 * whole


@pytest.mark.parametrize("change", [{"shadow": 1.0}, {"tile": 64}, {"tile": 1000}])
def test_wrong_settings_are_refused(change) -> None:
    with pytest.raises(ConfigError, match="matte"):
        MatteConfig(**change)


def moved(plate: np.ndarray, pixels: float) -> np.ndarray:
    motion = np.array([[1, 0, pixels], [0, 1, -pixels]])
    return cv2.warpAffine(
        plate, motion, plate.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def test_a_plate_that_fits_stays_as_it_is() -> None:
    scene = hair_before("dark", "cluttered", 256, np.random.default_rng(0))
    matched = match_plate(scene.plate, scene.frame, np.ones((256, 256), bool))
    assert matched.plate is scene.plate and matched.share > GOOD_SHARE


@pytest.mark.parametrize(("pixels", "slope"), [(3.0, 0.0), (0.0, 0.4), (-2.5, 0.3)])
def test_a_shifted_plate_and_one_in_other_light_are_brought_to_the_frame(
    pixels: float, slope: float
) -> None:
    scene = hair_before("dark", "cluttered", 256, np.random.default_rng(0))
    light = 1.1 + slope * (np.arange(256) / 256 - 0.5)
    relit = linear_to_srgb(srgb_to_linear(scene.plate / 255) * light[:, None])
    wrong = moved(np.rint(255 * np.clip(relit, 0, 1)).astype(np.uint8), pixels)
    valid = np.ones((256, 256), bool)
    matched = match_plate(wrong, scene.frame, valid)
    before, after, right = (
        np.abs(key_alpha(scene.frame, plate, valid, MatteConfig().shadow) - scene.true).mean()
        for plate in (wrong, matched.plate, scene.plate)
    )
    assert matched.share > LEAST_SHARE
    assert after < 3 * right
    if pixels:
        assert after < 0.6 * before
    else:
        assert before < 3 * right  # keying sees a change of light by itself


def test_a_plate_of_another_room_explains_nothing() -> None:
    scene, other = (
        hair_before("dark", "cluttered", 256, np.random.default_rng(seed)) for seed in (0, 1)
    )
    valid = np.ones((256, 256), bool)
    assert match_plate(other.plate, scene.frame, valid).share < 0.5 < LEAST_SHARE


def test_a_plate_is_compared_beside_a_person_whose_place_is_known() -> None:
    """A body may leave a turned camera's picture at two sides."""
    scene = hair_before("dark", "cluttered", 256, np.random.default_rng(0))
    valid, body = np.ones((256, 256), bool), np.zeros((256, 256), bool)
    body[:20, 60:200] = body[60:200, :20] = True
    frame = scene.frame.copy()
    frame[body] = 90
    assert match_plate(scene.plate, frame, valid).share < LEAST_SHARE
    person = cv2.dilate(scene.true, np.ones((9, 9))) > 0
    person[body] = True
    found = match_plate(scene.plate, frame, valid, person)
    assert found.sure and found.beside and found.plate is scene.plate
    anywhere = match_plate(scene.plate, frame, valid, person=np.ones((256, 256), bool))
    assert not anywhere.beside and anywhere.share < LEAST_SHARE
    other = hair_before("dark", "cluttered", 256, np.random.default_rng(1))
    assert match_plate(other.plate, frame, valid, person).share < 0.5


@pytest.mark.parametrize("turns", range(4))
def test_a_plate_of_a_camera_on_its_side_fits(turns: int) -> None:
    """The body leaves its picture at any side."""
    scene = hair_before("dark", "cluttered", 256, np.random.default_rng(0))
    frame = scene.frame.copy()
    frame[-60:, 30:226] = 90  # the shoulders
    plate, turned = (np.ascontiguousarray(np.rot90(i, turns)) for i in (scene.plate, frame))
    matched = match_plate(plate, turned, np.ones((256, 256), bool))
    assert matched.sure and matched.plate is plate


@pytest.mark.parametrize(("light", "kept"), [((0.2, 0.2, 0.2), True), ((0.2, 0.5, 0.9), False)])
def test_a_plate_with_a_hard_shadow_on_its_border_fits(light: tuple, kept: bool) -> None:
    """What is there in another colour does not show the plate."""
    scene = hair_before("dark", "cluttered", 256, np.random.default_rng(0))
    frame = scene.frame.copy()
    for side in (np.s_[70:130, :16], np.s_[70:130, -16:]):
        frame[side] = 255 * linear_to_srgb(srgb_to_linear(frame[side] / 255) * light)
    matched = match_plate(scene.plate, frame, np.ones((256, 256), bool))
    assert (matched.share >= LEAST_SHARE) == kept == matched.sure


@pytest.mark.parametrize("shape", [(2, 2), (8, 300), (64, 64)])
@pytest.mark.parametrize("level", [0, 255])
def test_blank_and_tiny_plates_give_finite_mattes(shape: tuple[int, int], level: int) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    plate = np.full_like(frame, level)
    for valid in (np.ones(shape, bool), np.zeros(shape, bool)):
        matched = match_plate(plate, frame, valid)
        assert 0 <= matched.share <= 1 and matched.plate.shape == frame.shape


def shirt_before(wall: tuple[int, int, int], gap: bool = False) -> Scene:
    """Return a head above a shirt that leaves the picture, before a wall with a patch.

    The patch behind the shirt has the colours of ``wall``; ``gap`` cuts it out of the shirt.
    """
    rng = np.random.default_rng(5)
    plate = np.full((256, 256, 3), 150.0)
    patch = np.zeros((256, 256), np.uint8)
    cv2.rectangle(patch, (114, 206), (144, 256), 1, -1)
    plate[patch > 0] = wall
    alpha = np.zeros((256, 256), np.float32)
    cv2.ellipse(alpha, (128, 250), (110, 110), 0, 180, 360, 1.0, -1)
    alpha[240:] = alpha[240]
    alpha[gap & (patch > 0)] = 0
    subject = np.full((256, 256, 3), (70.0, 84.0, 110.0))
    cv2.circle(subject, (128, 110), 50, (205, 160, 138), -1)
    cv2.circle(alpha, (128, 110), 50, 1.0, -1)
    frame = np.where(alpha[..., None] > 0, subject, plate)
    frame, plate = (
        np.clip(image + rng.normal(0, 2, image.shape), 0, 255).round().astype(np.uint8)
        for image in (frame, plate)
    )
    return Scene(frame=frame, plate=plate, alpha=alpha)


def test_a_shirt_of_the_walls_colour_has_no_hole_at_the_lower_border() -> None:
    scene = shirt_before(wall=(70, 84, 110))
    assert mae(key(scene), scene) < 0.003
    assert key(scene)[195:, 108:150].min() > 0.9


def test_a_gap_in_a_shirt_shows_a_wall_of_another_colour() -> None:
    scene = shirt_before(wall=(96, 112, 140), gap=True)
    assert mae(key(scene), scene) < 0.006
    assert key(scene)[216:, 122:136].max() < 0.1


def man_in_black(texture: float, shade: float = 1.0, moved: int = 0) -> Scene:
    """Return a head above a shirt that has the colour of a wall, but not its `texture` (levels).

    The left half of the wall is `shade` times as bright in the frame as in the plate, and its
    texture lies `moved` pixels to the side.
    """
    rng, size = np.random.default_rng(8), 320
    weave = cv2.GaussianBlur(rng.normal(0, 1, (size, size)), (0, 0), 1.2)
    weave = (texture * weave / weave.std())[..., None]
    alpha = np.zeros((size, size), np.float32)
    cv2.ellipse(alpha, (160, 320), (120, 130), 0, 180, 360, 1.0, -1)
    cv2.circle(alpha, (160, 130), 62, 1.0, -1)
    subject = np.full((size, size, 3), 31.0)
    cv2.circle(subject, (160, 130), 62, (205, 160, 138), -1)
    wall = 30 + np.roll(weave, moved, axis=1) + np.zeros(3)
    wall[:, :160] *= shade
    images = np.where(alpha[..., None] > 0, subject, wall), 30 + weave + np.zeros(3)
    frame, plate = (
        np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).round().astype(np.uint8)
        for image in images
    )
    return Scene(frame=frame, plate=plate, alpha=alpha)


def test_a_shirt_of_the_walls_colour_hides_its_texture() -> None:
    scene = man_in_black(texture=2.5)
    assert mae(key(scene), scene) < 0.015
    assert key(scene)[scene.alpha == 0].mean() < 0.003
    smooth = man_in_black(texture=0)  # nothing tells the two apart, and nothing is made up
    assert mae(key(smooth), smooth) > 0.15


@pytest.mark.parametrize("change", [{"shade": 0.7}, {"moved": 3}])
def test_a_wall_in_shadow_or_another_texture_is_not_a_shirt(change: dict) -> None:
    scene = man_in_black(texture=2.5, **change)
    assert key(scene)[scene.alpha == 0].mean() < 0.01
