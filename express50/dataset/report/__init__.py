"""One self-contained HTML page of a dataset: QC of every stage, errors where truth exists."""
