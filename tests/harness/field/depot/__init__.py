"""Tests of the depot: mission files, collected exports and the merged record."""
