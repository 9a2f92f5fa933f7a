"""Parts of the page, the page of several stations, and the answers of the web server."""
