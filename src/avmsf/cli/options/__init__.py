"""What each verb can be told, one module a verb: importing these imports nothing that computes.

So a mistake in a command is answered before the libraries are loaded that the verb itself needs.
"""
