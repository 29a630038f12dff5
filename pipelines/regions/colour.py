"""Separate hair, skin and torso by colour where geometry alone is not sure.

Pixels that geometry is sure of give histograms of the colours of hair, skin and torso; every other
pixel takes the class that its colour and place make most likely. In views from behind, or of a face
that hair hides, half of the skin's colours come from views of the face. The constants were set on
the digital twin's four people (docs/LOG.md, Parts).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes, gaussian_filter

from express50.contract.segmentation_labels import LABELS, label_mask
from express50.geometry.pixels import LIGHT_OF_LEVEL, disc, edge_distance, is_grey
from express50.geometry.sampling import robust_moments
from pipelines.regions.geometry import HAIR, SCALP, TORSO, HeadGeometry

SKIN, NECK, EARS = (np.uint8(LABELS.index(name)) for name in ("skin", "neck", "ears"))

SOLID = 0.99  # alpha above which a pixel shows the subject's colour alone

# Histograms of Lab colours.
CELLS, STEPS = (32, 64, 64), (8, 4, 4)  # 8-bit Lab in cells: light varies more than hue does
SMOOTH = 1.5  # cells; a few hundred pixels fill a smooth histogram
LEAST = 30  # fewest pixels that make a histogram
FEATURES = 0.003  # share of the mesh that eyes and lips fill where a view sees the face
SHARED = 10_000  # pixels that skin colours of the view itself and of others count as, if both count
COVERED = 0.1  # share of odd colours in a view's skin that is a beard; bare faces have 0.02 to 0.05
DARK = 1e-3  # root of light that is added to pixels: keeps logarithms finite
# Least and most spreads of the logarithms of brightness and of two ratios of colours, and how many
# of them are skin. Hard light spreads brightness; ratios are spread further only if hair counts.
LEAST_SPREAD, MOST_SPREAD = np.array([0.2, 0.03, 0.03]), np.array([np.inf, 0.07, 0.07])
WITHIN = 3.0
RARE = 1e-6  # share of a cell without samples: keeps logarithms finite
UNSEEN_CLASS_SHARE = 1.2e-4  # of every cell of a class without samples: spread over 8000 cells

# Places, metres above the neck's end, where geometry is sure of a class.
SURE_BELOW, SURE_ABOVE = -0.01, 0.10
# Lower hair hangs from the head in strands as wide as this; wisps reach this far from them.
STRAND_M, WISP_M = 0.005, 0.02
# Skin apart from the head that covers less than this share of it is a speck of the torso.
SPECK = 0.02

# Log-priors by place, nats: UNLIKELY marks what occurs at edges, IMPOSSIBLE what cannot be.
UNLIKELY, IMPOSSIBLE = -1.0, -20.0
FADE = 0.02  # metres of height per nat for head or torso
# Hair and skin on the mesh; torso is possible on the neck alone. Hair often falls over necks.
_ON_MESH = {
    int(SKIN): (UNLIKELY, 0.0),
    SCALP: (0.0, 0.0),
    int(EARS): (UNLIKELY, 0.0),
    int(NECK): (-0.5, 0.0),
}

# Bare scalps.
COMPARED_PIXELS = 4000  # pixels of scalp and of face that a view compares
LEAST_SCALP = 0.1  # pixels of scalp per pixel of the face: temples alone are often bare
# Most by which a bare scalp differs from the face's middle, in brightness and ratios of colours.
# Spreads of the face's own do not help: they are wide in hard light, where hair then passes for it.
UNLIKE = WITHIN * LEAST_SPREAD
# Share of the variance of a face's redness between its two groups from which it has two colours:
# normal values have 0.64, even ones 0.75.
TWO_COLOURED = 0.77
# The redder group's share of a side of the face is less than this in less red light, and more than
# the rest in redder light.
OTHER_LIGHT = 0.4
# Masks: least difference from the skin about the eyes in redness; ratios of colours below which
# nothing is skin or hair; more brightness than skin's, of white ones; least share of the lips and
# of the skin below them that has one colour. Parts of the face are in units of `_axes_of_face`.
UNLIKE_SKIN, COLD, WHITE, ONE_COLOUR = 0.18, -0.05, 0.1, 0.5
UPPER_FACE, LOWER_FACE = (-0.6, 0.45), (0.6, 1.4)
PLEATS = np.array([0.6, 0.12, 0.12])  # most by which a mask's pixels differ from its usual colour
MASK_REACH_M = 0.08  # from the lips
COHERENT = 0.75  # share of a face near its middle colour below which a fringe may cover it
BARE = 0.6  # share of the scalp in the face's colours, over the same of the face, of bare scalps


def face_colours(rgb: np.ndarray, alpha: np.ndarray, mesh: np.ndarray) -> np.ndarray | None:
    """Count (CELLS) the skin's colours in a view of the face; None in grey and other views.

    The frame (H, W, 3) is uint8 sRGB, alpha (H, W) in [0, 1], `mesh` (H, W) the mesh's labels.
    """
    if is_grey(rgb) or not _sees_face(mesh):
        return None
    solid = alpha > SOLID
    skin = bare_skin(rgb, (mesh == SKIN) & solid, mesh, solid)
    return _counts(_cells(rgb), skin) if skin.sum() >= LEAST else None


def colour_logs(rgb: np.ndarray) -> np.ndarray:
    """Return logarithms of root light (..., 3) of pixels (..., 3) uint8."""
    return np.log(np.sqrt(LIGHT_OF_LEVEL[rgb].astype(np.float64)) + DARK)


def _ratios(logs: np.ndarray) -> np.ndarray:
    """Return brightness and two ratios of colours (N, 3), logarithms, of `colour_logs` (N, 3).

    Shading changes brightness much, ratios of colours little.
    """
    r, g, b = logs.T
    return np.stack([(r + g + b) / 3.0, r - g, g - b], axis=1)


def _redder(redness: np.ndarray) -> np.ndarray:
    """Mark the redder (N,) of two groups of values (N,); all of them unless they are far apart.

    Otsu's threshold splits them. Skin is redder than beards, fringes and sunglasses, which together
    may cover so much of a face that its median and spread say little about skin.
    """
    order = np.sort(redness.astype(np.float64))
    if len(order) < LEAST:
        return np.ones(redness.shape, bool)
    count = np.arange(1, len(order))
    total = np.cumsum(order)
    low = total[:-1] / count
    apart = (total[-1] - total[:-1]) / (len(order) - count) - low
    share = count / len(order)
    between = share * (1 - share) * apart**2
    cut = int(between.argmax())
    two = between[cut] > TWO_COLOURED * order.var() and apart[cut] > 2 * UNLIKE[1]
    if not two or min(share[cut], 1 - share[cut]) < COVERED:
        return np.ones(redness.shape, bool)
    return redness > order[cut]


def like_skin(values: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Mark the colours (N, 3) that are like the skin of a face (M, 3); logarithms of root light."""
    known = _ratios(face)
    low, high = _range_of_most(known[_redder(known[:, 1])])
    ratios = _ratios(values)
    return ((ratios > low) & (ratios < high)).all(1)


def _range_of_most(known: np.ndarray) -> np.ndarray:
    """Return the lower and upper limits (2, 3) within which most of some `_ratios` (M, 3) lie."""
    usual, spread = robust_moments(known)
    reach = WITHIN * np.clip(spread, LEAST_SPREAD, MOST_SPREAD)
    return np.stack([usual - reach, usual + reach])


def like_skin_around(face: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Mark the colours (N,) of a face (N, 3) that are like most of it; logarithms of root light.

    `left` (N,) bool marks those on one side: in `_two_lights`, skin has the colours of either side
    and those in between.
    """
    if not _two_lights(face, left):
        return like_skin(face, face)
    ratios = _ratios(face)
    ranges = np.stack([_range_of_most(ratios[side]) for side in (left, ~left)])
    low, high = ranges[:, 0].min(0), ranges[:, 1].max(0)
    return ((ratios > low) & (ratios < high)).all(1)


def _two_lights(face: np.ndarray, left: np.ndarray) -> bool:
    """Return whether light of another colour falls on one side of a face, as in `like_skin_around`.

    It does not darken that side much. Beards, fringes and glasses do, or are on both sides.
    """
    ratios = _ratios(face)
    redder = _redder(ratios[:, 1])
    if redder.all() or min(left.sum(), (~left).sum()) < LEAST:
        return False
    less, more = sorted(float(redder[side].mean()) for side in (left, ~left))
    darker = np.median(ratios[redder, 0]) - np.median(ratios[~redder, 0])
    return bool(less < OTHER_LIGHT and more > 1 - OTHER_LIGHT and darker < UNLIKE[0])


def bare_skin(rgb: np.ndarray, skin: np.ndarray, mesh: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """Leave beards and hair, whose colours are unlike most of it, out of the skin (H, W).

    Brows, nostrils and shadows stay: they are a smaller share than COVERED. The mesh's labels
    (H, W) say where skin is seen if hair covers most of the face; the matte is `solid` (H, W).
    """
    if not skin.any():
        return skin
    logs, left = colour_logs(rgb[skin]), left_of_middle(mesh)[skin]
    sure = _uncovered(rgb, skin, mesh, solid)
    if sure is skin or _two_lights(logs, left):
        alike = like_skin_around(logs, left)
    else:
        alike = like_skin(logs, colour_logs(rgb[sure]))
    if alike.mean() > 1 - COVERED:
        return skin
    kept = skin.copy()
    kept[skin] = alike
    return kept


def mask_colour(rgb: np.ndarray, alpha: np.ndarray, mesh: np.ndarray) -> np.ndarray | None:
    """Return the colour (3,), ratios, of a mask over mouth and chin, NaN without one.

    Lips are redder than skin. Beards, which hide them too, have colours that hair has: none is blue
    or green, and white ones are rare where the scalp's hair is not white. The result is None in
    grey views and those that do not show the mouth. Arguments are those of `face_colours`.
    """
    axes = None if is_grey(rgb) else _axes_of_face(mesh)
    if axes is None:
        return None
    solid = alpha > SOLID
    lips, skin = label_mask(mesh, "lips") & solid, (mesh == SKIN) & solid
    upper, lower = (skin & (axes[0] > a) & (axes[0] < b) for a, b in (UPPER_FACE, LOWER_FACE))
    if min(part.sum() for part in (lips, upper, lower)) < LEAST:
        return None
    above, mouth, below = (_some_ratios(rgb[part]) for part in (upper, lips, lower))
    usual, own = np.median(above, axis=0), np.median(np.concatenate([mouth, below]), axis=0)
    one = min(_share_near(own, mouth), _share_near(own, below)) > ONE_COLOUR
    scalp = rgb[(mesh == SCALP) & solid]
    as_hair = len(scalp) >= LEAST and _share_near(own, _some_ratios(scalp)) > 1 - COHERENT
    white = own[0] > usual[0] + WHITE and len(scalp) >= LEAST
    masked = one and usual[1] - own[1] > UNLIKE_SKIN and not as_hair
    return own if masked and (_is_cold(own) or white) else np.full(3, np.nan)


def _is_cold(colour: np.ndarray) -> bool:
    """Return whether a colour (3,), ratios, is bluer or greener than any skin or hair."""
    return bool(colour[1:].min() < COLD)


def agreed_mask(said: Sequence[np.ndarray | None], bald: bool) -> np.ndarray | None:
    """Return the mask's colour (3,) by most views' `mask_colour`; None without a mask.

    A white one of a `bald` head may be a beard: no hair on the scalp shows whether that is white.
    """
    known = [colour for colour in said if colour is not None]
    masked = [colour for colour in known if np.isfinite(colour).all()]
    if 2 * len(masked) <= len(known):
        return None
    mask: np.ndarray = np.median(masked, axis=0)
    return None if bald and not _is_cold(mask) else mask


def worn_mask(
    rgb: np.ndarray, alpha: np.ndarray, mesh: np.ndarray, colour: np.ndarray, metre_px: float
) -> np.ndarray:
    """Find the pixels (H, W) bool of a mask of a colour (3,) of `mask_colour`, about the lips.

    ``metre_px`` is the number of pixels that a metre spans at the head.
    """
    alike, lips = np.zeros(mesh.shape, bool), label_mask(mesh, "lips")
    if not lips.any():
        return alike
    around = (edge_distance(~lips) < MASK_REACH_M * metre_px) & (alpha > 0.5)
    alike[around] = (np.abs(_ratios(colour_logs(rgb[around])) - colour) < PLEATS).all(1)
    # Shadows of pleats and a microphone belong to it, specks do not.
    wide, narrow = (disc(max(1, round(k * STRAND_M * metre_px))) for k in (1, 0.5))
    whole = cv2.morphologyEx(alike.astype(np.uint8), cv2.MORPH_CLOSE, wide)
    whole = cv2.morphologyEx(whole, cv2.MORPH_OPEN, narrow)
    _, part, stats, _ = cv2.connectedComponentsWithStats(whole, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] > COVERED * whole.sum()
    return binary_fill_holes((whole > 0) & large[part])


def left_of_middle(mesh: np.ndarray) -> np.ndarray:
    """Mark the pixels (H, W) on one side of the line through eyes and mouth of a mesh's labels."""
    axes = _axes_of_face(mesh)
    return np.zeros(mesh.shape, bool) if axes is None else axes[1] > 0


def _axes_of_face(mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return where pixels (H, W) lie along the line from eyes (0) to lips (1), and beside it.

    None if a mesh's labels (H, W) lack either.
    """
    ends = [np.argwhere(label_mask(mesh, name)) for name in ("eyes", "lips")]
    if not all(map(len, ends)):
        return None
    eyes, lips = (end.mean(0) for end in ends)
    down, across = lips - eyes
    row, column = np.ogrid[: mesh.shape[0], : mesh.shape[1]]
    row, column = row - eyes[0], column - eyes[1]
    length = max(down**2 + across**2, 1.0)
    return (row * down + column * across) / length, (column * down - row * across) / length


def _uncovered(
    rgb: np.ndarray, face: np.ndarray, mesh: np.ndarray, solid: np.ndarray
) -> np.ndarray:
    """Return pixels (H, W) of skin: the face's, or some that hair does not cover.

    Long hair over the face's sides leaves what is between eyes and mouth; a fringe hides that, too,
    but not the neck.
    """
    middle = _middle_of_face(rgb, mesh, solid)
    if middle is not None:
        of_face, of_middle = (np.median(_some_ratios(rgb[mask]), axis=0) for mask in (face, middle))
        apart = np.abs(of_face - of_middle)
        return face if (apart < UNLIKE / 2).all() else middle
    neck = (mesh == NECK) & solid
    if neck.sum() < LEAST:
        return face
    of_face, of_neck = (_some_ratios(rgb[mask]) for mask in (face, neck))
    usual = np.median(of_face, axis=0)
    # Skin is redder than most hair, and than the collars that hide necks.
    redder = np.median(of_neck[:, 1]) > usual[1] + UNLIKE[1]
    return neck if redder and _share_near(usual, of_face) < COHERENT else face


def _middle_of_face(rgb: np.ndarray, mesh: np.ndarray, solid: np.ndarray) -> np.ndarray | None:
    """Return the skin (H, W) bool between eyes and mouth, if it has one colour; else None.

    Neither beards nor long hair cover it, but fringes and sunglasses do.
    """
    features = label_mask(mesh, "eyes", "lips")
    if not features.any():
        return None
    between = np.zeros(mesh.shape, np.uint8)
    ends = np.argwhere(features)[:, ::-1].astype(np.int32)
    cv2.fillConvexPoly(between, cv2.convexHull(ends), 1)
    skin = (between > 0) & (mesh == SKIN) & solid
    if skin.sum() < LEAST:
        return None
    ratios = _some_ratios(rgb[skin])
    return skin if _share_near(np.median(ratios, axis=0), ratios) > COHERENT else None


def _sees_face(mesh: np.ndarray) -> bool:
    features = label_mask(mesh, "eyes", "lips").sum()
    return bool(features > FEATURES * np.count_nonzero(mesh))


def label_by_colour(
    rgb: np.ndarray,
    alpha: np.ndarray,
    geometry: HeadGeometry,
    bare: bool,
    skin_colours: np.ndarray | None,
    metre_px: float,
) -> np.ndarray:
    """Label pixels (H, W) uint8 by geometry, and hair, skin, ears, neck and torso by colour too.

    The frame (H, W, 3) is uint8 sRGB, alpha (H, W) in [0, 1]; `bare` says that the scalp is skin;
    `skin_colours` is the sum of the counts of `face_colours` of other views; `metre_px` is the
    number of pixels that a metre spans at the head.
    """
    labels, cells = geometry.labels(), _cells(rgb)
    solid = alpha > SOLID
    hair = solid & ((labels == SCALP) | ((labels == HAIR) & (geometry.height > SURE_ABOVE)))
    sees_face = _sees_face(geometry.mesh)
    face = solid & (geometry.mesh > 0) & (labels == SKIN)
    skin = face & (geometry.off == 0)  # in front of it are hair and hands
    hidden = not sees_face or 2 * skin.sum() < face.sum()
    if skin.sum() < LEAST:
        if not sees_face:  # hair may cover the neck
            skin = skin | (solid & (labels == NECK) & (geometry.height > SURE_ABOVE))
        elif skin_colours is None:  # all of the face is hidden, and no other view shows it
            skin = face
    covered = np.zeros_like(skin)
    if sees_face:  # from behind, most of it may be hair
        taught, skin = skin, bare_skin(rgb, skin, geometry.mesh, solid)
        covered = taught & ~skin
    torso = solid & (labels == TORSO) & (geometry.height < SURE_BELOW)
    beyond = IMPOSSIBLE
    if bare:
        # Without a scalp hair has the samples of a beard, if any, and what juts out of the mesh may
        # as well be skin.
        labels = np.where(labels == SCALP, SKIN, labels)
        hair, beyond = covered, 0.0
    counts = [_counts(cells, mask) for mask in (hair, skin, torso)]
    if skin_colours is not None and not bare and hidden:
        # Half of each, because the back of a neck may be darker than any face; or hair covers it.
        shares = [c / np.float32(max(c.sum(), 1.0)) for c in (*counts[:2], skin_colours)]
        by_hair, by_skin, by_others = (gaussian_filter(c, SMOOTH) for c in shares)
        _, own, others = shares
        if np.minimum(by_skin, by_hair).sum() > np.minimum(by_skin, by_others).sum():
            own = others
        counts[1] = SHARED * (own + others)
    # Log-likelihoods (3, H, W) of hair, skin and torso.
    likely = np.full((3, *cells[0].shape), np.log(UNSEEN_CLASS_SHARE), np.float32)
    for row, taught in zip(likely, counts, strict=True):
        if taught.sum() >= LEAST:
            shares = gaussian_filter(taught, SMOOTH) / taught.sum()
            row[:] = np.log(np.maximum(shares, 0) + RARE)[cells]
    if bare:  # what else has a beard's colours are shadows and clothes
        likely[0][geometry.near != SKIN] = np.log(UNSEEN_CLASS_SHARE)
    scores = likely + _priors(labels, geometry, beyond)
    best = scores.argmax(0)
    loose = _loose((best == 0) & (alpha > 0), geometry.height > SURE_ABOVE, metre_px)
    best = np.where(loose, 1 + scores[1:].argmax(0), best)
    around = (geometry.mesh > 0) | geometry.rim | bare
    kept = np.isin(geometry.near, (SKIN, NECK, EARS)) & around
    skin_label = np.where(kept, geometry.near, SKIN)
    unsure = (geometry.mesh == 0) | np.isin(geometry.mesh, list(_ON_MESH))
    labels = np.where(unsure, np.choose(best, [HAIR, skin_label, TORSO]), labels).astype(np.uint8)
    specks = unsure & (best == 1) & _small_parts((labels != TORSO) & (alpha > 0))
    return np.where(specks, TORSO, labels)


def _small_parts(head: np.ndarray) -> np.ndarray:
    """Find the parts (H, W) of the head (H, W) bool that are apart and small.

    In noise, shirts have single pixels in the colours of skin.
    """
    _, part, stats, _ = cv2.connectedComponentsWithStats(head.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    return head & (area < SPECK * area[1:].max(initial=0))[part]


def _loose(hair: np.ndarray, above: np.ndarray, metre_px: float) -> np.ndarray:
    """Find hair (H, W) that does not hang from the hair above (H, W) bool.

    Collars and the edges of shoulders often have the colours of hair.
    """
    narrow = disc(max(1, int(STRAND_M * metre_px) // 2))
    thick = cv2.morphologyEx(hair.astype(np.uint8), cv2.MORPH_OPEN, narrow)
    _, part = cv2.connectedComponents(thick, connectivity=8)
    hanging = (thick > 0) & np.isin(part, part[above & (thick > 0)])
    if not hanging.any():  # a picture of the neck alone does not show where its hair comes from
        return hanging
    return hair & ~above & (edge_distance(~hanging) > WISP_M * metre_px)


Cells = tuple[np.ndarray, ...]


def _cells(rgb: np.ndarray) -> Cells:
    """Find the cell of Lab, three indices (H, W), of each pixel (H, W, 3)."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB) // np.array(STEPS, np.uint8)
    return tuple(lab.transpose(2, 0, 1).astype(np.int64))


def _counts(cells: Cells, mask: np.ndarray) -> np.ndarray:
    """Count the pixels of a mask (H, W) in each of the CELLS."""
    counts = np.zeros(CELLS, np.float32)
    np.add.at(counts, tuple(axis[mask] for axis in cells), 1)
    return counts


def _priors(labels: np.ndarray, geometry: HeadGeometry, beyond: float) -> np.ndarray:
    """Return the log-prior (3, H, W) of hair, skin and torso by place.

    `beyond` is that of skin beyond the rim.
    """
    fade = np.clip(geometry.height / FADE, IMPOSSIBLE, -IMPOSSIBLE)
    above, below = np.maximum(fade, 0), np.minimum(fade, 0)
    on_mesh = geometry.mesh > 0
    skin_rim = geometry.rim & (geometry.near != SCALP)
    hair = below + np.where(skin_rim, UNLIKELY, 0)
    skin = below + np.where(skin_rim, 0, beyond)
    torso = np.where(on_mesh, IMPOSSIBLE, -above)
    for label, (on_hair, on_skin) in _ON_MESH.items():
        here = on_mesh & (labels == label)
        hair, skin = np.where(here, on_hair, hair), np.where(here, on_skin, skin)
    torso = np.where(on_mesh & (labels == NECK), UNLIKELY - above, torso)
    return np.stack([hair, skin, torso])


@dataclass(frozen=True)
class Scalp:
    """Whether the scalp is skin, and how much of it has the face's colours; None: unknown.

    The share of the scalp's pixels near the face's middle colour is divided by the share of the
    face's own, which is less than 1 in noise and hard light.
    """

    is_skin: bool
    skin_coloured: float | None


def _some_ratios(pixels: np.ndarray) -> np.ndarray:
    """Return `_ratios` of COMPARED_PIXELS of the pixels (N, 3) uint8, or of all."""
    chosen = np.linspace(0, len(pixels) - 1, COMPARED_PIXELS).astype(int)
    return _ratios(colour_logs(pixels[np.unique(chosen)]))


def _share_near(middle: np.ndarray, ratios: np.ndarray) -> float:
    """Measure the share of `_ratios` (N, 3) that could be skin of the middle colour (3,)."""
    return float((np.abs(ratios - middle) < UNLIKE).all(1).mean())


def scalp_votes(rgb: np.ndarray, labels: np.ndarray, alpha: np.ndarray) -> tuple[int, int]:
    """Count the pixels of a scalp that have the face's colours if it is bare, and those that do.

    The view's own face is taken, because other cameras differ in gain and light. Grey views, those
    without a face, with little of the scalp, or in which hair may hide most of the skin count none.
    The frame (H, W, 3) is uint8 sRGB; `labels` (H, W) are the mesh's, SCALP among them; alpha
    (H, W) is in [0, 1].
    """
    if is_grey(rgb):
        return 0, 0
    solid = alpha > SOLID
    skin, scalp = ((labels == label) & solid for label in (SKIN, SCALP))
    least = max(LEAST, LEAST_SCALP * skin.sum())
    if not _sees_face(labels) or skin.sum() < LEAST or scalp.sum() < least:
        return 0, 0
    middle = _middle_of_face(rgb, labels, solid)
    sure = _uncovered(rgb, skin, labels, solid) if middle is None else middle
    of_skin, of_scalp = (_some_ratios(rgb[mask]) for mask in (sure, scalp))
    usual_colour = np.median(of_skin, axis=0)
    usual, found = (_share_near(usual_colour, ratios) for ratios in (of_skin, of_scalp))
    if sure is skin:  # unless noise alone spreads its colours, it may be hair
        even = _some_ratios(cv2.blur(rgb, (5, 5))[skin])
        if _share_near(np.median(even, axis=0), even) < COHERENT:
            return 0, 0
    return round(len(of_scalp) * usual), round(len(of_scalp) * found)


def judge_scalp(votes: Sequence[tuple[int, int]]) -> Scalp:
    """Call the scalp bare where it has the face's colours, by the votes of all views."""
    expected = sum(count for count, _ in votes)
    if not expected:
        return Scalp(False, None)
    share = round(min(1.0, sum(alike for _, alike in votes) / expected), 4)
    return Scalp(share > BARE, share)
