"""What studies have found: choice of physics, identification, excitation, margins, tuning.

Imports the tables and the style of the room above, and no other room of it.
"""
