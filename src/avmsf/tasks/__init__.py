"""What a sound field is for: find the blow, change the material."""
