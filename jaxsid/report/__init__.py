"""Results for people: figures, an HTML page, a summary for the terminal, and identification.json."""
