"""Published recordings of many objects, each read as the `Capture` that a folder made by hand would give."""
