"""What reports, tables and commands show with: words, colours, SVG, Markdown, and JUnit XML for build servers."""
