"""What trained policies did, as tables and pictures."""
