"""Studies for science: searches, comparisons, tuned gaits, the paper's page. Only `cli` imports this package."""
