"""Modes from recordings: candidate poles, selection, least squares and alignment of the recordings."""
