"""Operations over a finished dataset: tracks, audit, report, export, withdrawal."""
