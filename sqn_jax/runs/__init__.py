"""Training and evaluation as commands run them: progress, signals, files, final evaluation."""
