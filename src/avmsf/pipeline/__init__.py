"""All the way from a capture folder to a field, stage by stage; only what changed is made anew."""
