"""This room works on finished datasets: tracks, audit, report, export, withdrawal."""
