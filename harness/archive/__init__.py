"""What a run leaves: written while it goes on, and read back whatever has become of it since."""
