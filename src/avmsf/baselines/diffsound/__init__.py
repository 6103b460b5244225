"""DiffSound (Jin et al., SIGGRAPH 2024): elastic modes of a material fitted to recordings."""
