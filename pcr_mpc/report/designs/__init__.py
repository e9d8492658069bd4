"""What `check`, `new` and `plan` have found, in words, tables and pictures.

Imports the tables and the style of the room above, and no other room of it.
"""
