"""Results drawn: SVG and HTML as text, for the panel and for pages of their own."""
