import re

import numpy as np
import pytest

from express50.capture.expressions import load_script, select
from express50.errors import FormatError


def test_script_has_sixty_expressions_and_starts_neutral():
    script = load_script()
    assert len({e.id for e in script}) == len(script) == 60
    assert script[0].id == "neutral"
    assert not script[0].controls and not any((*script[0].jaw, *script[0].neck, *script[0].gaze))


def test_ids_of_other_captures_exist():
    wanted = ["neutral", "smile", "jaw_open", "pucker", "brow_raise", "anger", "shout", "wink_left"]
    assert [e.id for e in select(wanted)] == wanted


def test_every_description_names_the_motion():
    script = load_script()
    assert all(len(e.description) > 20 for e in script)
    assert sum(bool(re.search(r"AU\d", e.description)) for e in script) >= 55


def test_expressions_differ_from_each_other():
    names = sorted({k for e in load_script() for k in e.controls})
    rows = np.array(
        [
            [*(e.controls.get(k, 0.0) for k in names), *e.jaw, *e.neck, *e.gaze]
            for e in load_script()
        ]
    )
    gaps = np.linalg.norm(rows[:, None] - rows[None], axis=-1) + 10 * np.eye(len(rows))
    assert gaps.min() > 0.25


def test_values_are_within_what_a_face_can_do():
    for e in load_script():
        assert all(-1.0 <= value <= 1.3 for value in e.controls.values()), e.id
        assert (
            0.0 <= e.jaw[0] <= 0.5 and np.abs(e.neck).max() <= 0.5 and np.abs(e.gaze).max() <= 0.7
        )


def test_mirrored_expressions_mirror_their_controls():
    left, right = select(["wink_left", "wink_right"])
    swap = {"_L": "_R", "_R": "_L"}
    assert {k[:-2] + swap[k[-2:]]: v for k, v in left.controls.items()} == right.controls


def test_rows_have_the_documented_types_and_shapes():
    for e in load_script():
        assert re.fullmatch("[a-z][a-z0-9_]*", e.id) and e.name
        assert (len(e.jaw), len(e.neck), len(e.gaze)) == (3, 3, 2), e.id
        assert np.isfinite([*e.controls.values(), *e.jaw, *e.neck, *e.gaze]).all(), e.id


def test_unknown_id_names_the_nearest():
    with pytest.raises(FormatError, match="smile"):
        select(["smille"])
