"""Functions shared by the command line and `import surefoot`: policies by name, trainings, episodes, the drive page."""
