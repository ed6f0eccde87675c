"""Episodes of policies and baselines, their scores and statistics."""
