"""Helpers for output: text, colours, SVG charts, Markdown, and JUnit XML."""
