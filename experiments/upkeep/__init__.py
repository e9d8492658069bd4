"""What keeps pages, pictures and tests honest."""
