"""Every stage may rely on this room: layout, configuration, stage, labels of parts."""
