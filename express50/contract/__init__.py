"""The contract every stage may rely on: layout, configuration, stage, labels of parts."""
