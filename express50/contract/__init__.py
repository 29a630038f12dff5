"""Define what every stage relies on: layout, configuration, stage, segmentation labels."""
