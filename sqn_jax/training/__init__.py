"""Rollouts and learning in one compiled program."""
