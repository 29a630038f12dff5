"""Work on finished datasets: tracks, audit, report, export, withdrawal."""
