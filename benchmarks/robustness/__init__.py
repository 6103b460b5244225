"""How files and requests that are damaged, oversized or hostile are answered."""
