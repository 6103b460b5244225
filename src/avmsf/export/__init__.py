"""What carries a field into the tools that people use."""
