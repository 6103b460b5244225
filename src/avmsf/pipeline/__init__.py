"""All the way from a capture folder to a field, stage by stage, each kept and made anew only where something changed."""
