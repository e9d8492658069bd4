"""Names of the ways to solve the rods' statics: for plant, controller and command line, which import each other not."""

METHODS = ("closed_form", "multiple_shooting", "single_shooting")
