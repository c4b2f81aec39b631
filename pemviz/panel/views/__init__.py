"""Arrays to HTML and SVG text: pure functions that know no browser library."""
