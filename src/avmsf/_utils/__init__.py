"""Small helpers that every package may use; none of them is public."""
