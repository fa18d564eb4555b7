"""What the command line and `import surefoot` share: policies by name, trainings, episodes, the drive page."""
