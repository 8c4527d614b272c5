"""What a fit found, as one page that can be read, looked at and heard."""
