"""Gains over the surface of an object: see `avmsf.field` for the model, `mixture` for its mathematics."""
