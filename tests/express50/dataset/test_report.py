"""The report page: everything inside one file, failures and drops named, nothing invented."""

import base64
import json
import re

import numpy as np
import pytest

from express50.__main__ import main
from express50.contract.layout import Dataset
from express50.dataset.report import number, render_page
from express50.files.images import decode_image, write_image
from express50.runner.ledger import IMPORTED, Ledger, Receipt


@pytest.fixture
def dataset(tmp_path):
    root = tmp_path / "ds"
    for stage, item, metrics in [
        ("ingest", "S1", {"frames": 12}),
        ("matte", "S1/cam0", {"coverage": 0.25, "dropped": [{"what": "smile", "why": "no plate"}]}),
        ("matte", "S1/cam1", {"coverage": 0.5}),
        ("align", "S1", {"peaks": 1}),
    ]:
        folder = root / stage / item
        (folder / "qc").mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(metrics))
        write_image(folder / "qc" / "view.jpg", np.full((20, 60, 3), 90, np.uint8))
    (root / "ingest" / "S1" / "index.json").write_text("{}")
    (root / "align" / "S1" / "peaks.json").write_text(json.dumps({"smile": {"frame": 3}}))
    dataset = Dataset(root)
    with Ledger(dataset.ledger) as ledger:
        ledger.write(
            Receipt(
                stage="matte",
                item="S1/cam2",
                fingerprint="",
                status="failed",
                reason="<torn> video",
            )
        )
    return dataset


def test_the_page_needs_no_other_file(dataset):
    page = render_page(dataset)
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources
    assert all(s.startswith(("data:", "#")) for s in sources)
    assert page.count("data:image/jpeg;base64,") == 4


def test_imported_items_are_named_as_such(dataset):
    assert "another tool" not in render_page(dataset)
    with Ledger(dataset.ledger) as ledger:
        for camera in ("cam0", "cam1"):
            made = {"stage": "matte", "item": f"S1/{camera}", "status": "done", "reason": ""}
            ledger.write(Receipt(fingerprint=f"{IMPORTED}x", **made))
    assert "Imported: 2 of these items were made by another tool." in render_page(dataset)


def test_figures_have_readable_names_and_units(dataset):
    summary = {"train.psnr_heldout_view_db": 26.6, "peak_memory_gib": 1.2}
    (dataset.root / "summary.json").write_text(json.dumps(summary))
    path = dataset.root / "matte" / "S1" / "cam0" / "metrics.json"
    path.write_text(json.dumps({"abs_error_mm_median": 1.5}))
    page = render_page(dataset)
    for label in ("train: PSNR held-out view, dB", "peak memory, GiB", "abs error median, mm"):
        assert label in page


def test_failures_and_drops_are_named_and_escaped(dataset):
    page = render_page(dataset)
    assert "S1/cam2" in page
    assert "&lt;torn&gt; video" in page
    assert "no plate" in page


def test_a_stage_whose_every_item_failed_is_shown(dataset):
    with Ledger(dataset.ledger) as ledger:
        ledger.write(
            Receipt(stage="track", item="S1", fingerprint="", status="failed", reason="no face")
        )
    page = render_page(dataset)
    assert "no face" in page and 'href="#track"' in page and 'href="#depth"' not in page


def test_pictures_of_16_bits_keep_their_brightness(dataset):
    path = dataset.root / "ingest/S1/qc/deep.png"
    write_image(path, np.full((20, 60), 90 * 257, np.uint16))
    data = re.findall(r'base64,([^"]*)"', render_page(dataset))
    levels = [decode_image(base64.b64decode(one)).mean() for one in data]
    assert np.allclose(levels, 90, atol=2) and len(levels) == 5


def test_damaged_pictures_and_logs_do_not_stop_the_page(dataset):
    picture = dataset.root / "align/S1/qc/view.jpg"
    picture.write_bytes(picture.read_bytes()[:-200])
    log = dataset.root / "grmm/train/log.jsonl"
    log.parent.mkdir(parents=True)
    rows = [json.dumps({"iteration": n, "loss": 1 / n}) for n in (1, 2, 3)]
    log.write_text("\n".join([*rows, '{"iteration": 4, "lo']))
    (log.parent / "metrics.json").write_text(json.dumps({"iterations": 3}))
    page = render_page(dataset)
    assert page.count("data:image/jpeg;base64,") == 3
    assert "S1: view: cannot be shown" in page and "Loss over training" in page


def test_outputs_without_a_ledger_are_shown(dataset):
    for path in dataset.root.glob(f"{dataset.ledger.name}*"):
        path.unlink()
    assert "no plate" in render_page(dataset)


def test_warnings_are_named(dataset):
    assert "in doubt" not in render_page(dataset)
    folder = dataset.root / "calibrate" / "S1"
    folder.mkdir(parents=True)
    metrics = {"warnings": [{"what": "cam7", "why": "9 corners"}, "no row"]}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    page = render_page(dataset)
    assert "Warnings (1)" in page and "cam7: 9 corners" in re.sub("<[^>]*>", "", page)


def test_truth_and_training_are_silent_where_absent(dataset):
    page = render_page(dataset)
    assert "Accuracy against ground truth" not in page
    assert 'id="grmm"' not in page
    (dataset.root / "accuracy").mkdir()
    (dataset.root / "accuracy" / "accuracy.json").write_text('{"matte.mae": 0.0123}')
    assert "0.0123" in render_page(dataset)


def test_the_same_dataset_gives_the_same_page(dataset):
    assert render_page(dataset) == render_page(dataset)


def test_plots_do_not_grow_with_the_items(tmp_path):
    for place in range(300):
        folder = tmp_path / "matte" / f"S{place:03d}" / "smile"
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps({"coverage": place / 1000}))
    page = render_page(Dataset(tmp_path))
    assert page.count("<path") < 150 and "288 more items" in page


def test_command_writes_the_page_and_refuses_an_empty_folder(dataset, tmp_path, capsys):
    assert main(["report", str(dataset.root), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] > 1000
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert "no such dataset" in capsys.readouterr().err
    to_site = ["report", str(dataset.root), "--out", str(tmp_path / "site")]
    assert main(to_site) == 0 and main(to_site) == 0, "an earlier report is replaced"
    (tmp_path / "site/index.html").write_text("mine")
    assert main(to_site) == 2 and (tmp_path / "site/index.html").read_text() == "mine"


def test_figures_read_as_a_person_would():
    assert [number(x) for x in (None, 3, 3.14159, 12345.6, True)] == [
        "n/a",
        "3",
        "3.14",
        "12,346",
        "True",
    ]


def test_wide_contact_sheets_take_the_whole_width(dataset):
    page = render_page(dataset)
    assert page.count('<figure class="wide"><img') == 4
