"""The page where an object is struck and heard, and the server of this one machine behind it."""
