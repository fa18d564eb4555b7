"""Web pages, served or written as one self-contained file."""
