"""Results for people: figures, one HTML page, a summary for the terminal, and the JSON of an identification."""
