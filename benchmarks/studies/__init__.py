"""The commands beside `run`: each measures, draws and shows one thing; see `_study`."""
