"""Data of the page's map and curves: static files that a browser reads from any folder or server."""
