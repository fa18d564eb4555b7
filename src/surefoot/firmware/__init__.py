"""Robot firmware in C: sources, and the generator of a firmware project for one robot."""
