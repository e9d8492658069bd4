"""What hardware adds to a loop: motors that lag, cameras that are late."""
