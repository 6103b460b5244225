"""The web page that plays an object, and its local server."""
