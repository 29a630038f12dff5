"""The annotator without the landmark network."""

import pytest
import textual._wait

from annotations.ui.app import AnnotateApp
from annotations.ui.session import Session


@pytest.fixture(autouse=True)
def quick_pilot(monkeypatch):
    """The pilot looks whether the app is idle every 4 ms, not every 20, twice a key.

    What a key set off is waited for all the same: every press ends when the screen and all its
    widgets have handled their messages.
    """
    monkeypatch.setattr(textual._wait, "SLEEP_GRANULARITY", 0.004)


@pytest.fixture
def make_app():
    """An app over a dataset, without the landmark network."""

    def make(dataset, annotator="ann", **options):
        options.setdefault("order", "subject")
        return AnnotateApp(Session(dataset, annotator, **options))

    return make
