"""Many runs of robots that are not as believed, one after the other or on any executor."""
