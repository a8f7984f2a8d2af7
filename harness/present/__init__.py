"""Helpers for all output: text, colours, SVG charts, Markdown, and JUnit XML."""
