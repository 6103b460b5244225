"""What a verb is doing, on the standard error: one display for the whole process."""

from avmsf.pipeline.progress import ProgressDisplay

display = ProgressDisplay()
"""Quiet or verbose by the options of the verb that runs."""
say = display.say
doing = display.doing
