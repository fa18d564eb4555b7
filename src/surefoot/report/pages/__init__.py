"""Pages for a browser, served or written as one file."""
