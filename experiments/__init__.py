"""Studies: each answers one question, by measurement."""
