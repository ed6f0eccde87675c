"""A training run as a person starts it: progress, signals, files, what follows it."""
