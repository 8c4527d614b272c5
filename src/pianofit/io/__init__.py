"""Files in and out: sound formats, text, tables and the formatting of numbers."""
