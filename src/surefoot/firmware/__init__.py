"""A robot's firmware in C: sources, and the project of one robot made from them."""
