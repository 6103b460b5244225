"""What fields are compared with: other systems' methods."""
