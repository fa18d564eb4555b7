"""Studies for science: searches, comparisons, handcrafted gaits, the paper's page. Only `cli` imports this package."""
