"""The annotator without the landmark network."""

import pytest

from annotations.ui.app import AnnotateApp
from annotations.ui.session import open_session


@pytest.fixture
def make_app():
    """An app over a dataset, without the landmark network."""

    def make(dataset, annotator="ann", **options):
        options.setdefault("order", "subject")
        return AnnotateApp(open_session(dataset, annotator, **options))

    return make
