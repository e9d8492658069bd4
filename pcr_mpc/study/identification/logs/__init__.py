"""What was recorded of a robot in motion: files, what is wrong with them, and the commands that go with the states.

Imports nothing of identification.
"""
