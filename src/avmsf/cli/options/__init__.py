"""The options of each command, one module for each: importing these imports nothing that computes.

So a mistake in a command is reported before the libraries are loaded that the command itself needs.
"""
