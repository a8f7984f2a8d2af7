"""What came home from a real flight: sorted, stepped through, and played again."""
