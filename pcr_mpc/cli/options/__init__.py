"""What each command may be told, by what it is about."""
