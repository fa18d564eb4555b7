"""Studies: comparisons of many trainings, hyperparameter search and gait tuning. Only `cli` imports this package."""
