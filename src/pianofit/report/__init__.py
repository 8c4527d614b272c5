"""The page of a fit: its results as text, pictures and sounds in one HTML file."""
