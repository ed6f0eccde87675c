"""What a run keeps on disk: its folder, checkpoints, compiled programs and kept arrays."""
