"""Trained policies: from run folders, from files, changed by hand."""
