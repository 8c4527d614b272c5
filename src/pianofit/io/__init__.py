"""Input and output: sound files, text files, tables and number formats."""
