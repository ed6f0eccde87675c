"""What comes from outside: reading files up to a limit, and printing what stands in them."""
